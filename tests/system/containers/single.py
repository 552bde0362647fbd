"""One node with a volume: flown against from a second container, stopped, and started again."""

import json

from engine import Command, answered, require, wait_until
from pump import check_download

# Enough flights that the second container is heard from more than once.
FLIGHTS = 8


def run(composition, image, missions, names):
    """What was precomputed: by mission, the id of the artifact and the digest of its bytes."""
    composition.up()
    node = composition.container("node")
    node.wait_healthy()
    fly(composition, image, missions)
    made = {name: precomputed(composition, image, missions, name) for name in names}

    require(node.stop() == 0, "the node did not end well")
    node.start()
    node.wait_healthy()
    address = wait_until("a published port", node.published, 10)
    for name, (artifact_id, content_sha256) in made.items():
        check_download(address, artifact_id, content_sha256)
        operation = answered(address, "GET", f"/v1/operations/{artifact_id}")
        require(operation["done"], f"the operation of {name} is not done any more")
    print(f"stopped and started again: {len(made)} artifacts are there, with the same digest")
    return made


def fly(composition, image, missions):
    """EnviSat, from a second container."""
    command = Command(
        composition, image, missions, "simulate", "/missions/envisat.json",
        "--server", "http://node:7440", "--runs", str(FLIGHTS), "--seed", "1",
        "--format", "json", "--no-pictures",
    )  # fmt: skip
    report = json.loads(command.result(120)[0])
    arrived = report["arrived"]
    require(arrived == FLIGHTS, f"{arrived} of {FLIGHTS} flights arrived")
    print(f"EnviSat from a second container: {arrived} of {FLIGHTS} flights arrived")


def precomputed(composition, image, missions, name):
    """Id and digest of a mission's artifact, made by `vbar precompute` in a second container."""
    command = Command(
        composition, image, missions, "precompute", f"/missions/{name}.json",
        "--server", "http://node:7440",
    )  # fmt: skip
    return told(command.result(900)[0], name)


def told(printed, name):
    """Id and digest in what `vbar precompute` printed."""
    artifact = json.loads(printed)["artifact"]
    provenance = artifact["provenance"]
    print(f"{name}: {artifact['sizeBytes']} bytes, sha256 {provenance['contentSha256']}")
    return provenance["artifactId"], provenance["contentSha256"]
