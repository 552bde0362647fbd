"""The deployments of docker/, in real containers: what they promise, and what they survive.

Usage: deployment.py (the images `vbar`, `vbar-nats` and `vbar-haproxy` of
docker/images-without-registry are there). `deployment.py single` leaves the cluster out.
"""

import sys
import time
from pathlib import Path

import cluster
import single
from engine import Composition, Failed

ROOT = Path(__file__).resolve().parents[3]
MISSIONS = ROOT / "simulator" / "missions"
IMAGE = "vbar"
IMAGES = {"IMAGE_VBAR": IMAGE, "IMAGE_NATS": "vbar-nats", "IMAGE_HAPROXY": "vbar-haproxy"}
# Long enough to be interrupted, short enough to be waited for.
PRECOMPUTED = ["iss", "poseidyn"]
# What is divided among one worker and two, undisturbed.
MEASURED = ["poseidyn"]


def deployed(name, body):
    """Runs `body` on a composition that leaves nothing behind; shows its logs if it fails."""
    started = time.monotonic()
    print(f"--- {name}", flush=True)
    composition = Composition(f"vbar-test-{name}", str(ROOT / f"docker/compose.{name}.yml"), IMAGES)
    try:
        composition.down()
        return body(composition)
    except Exception:
        for container in composition.everything():
            print(f"--- last words of {container}", container.logs(), sep="\n")
        raise
    finally:
        composition.down()
        print(f"--- {name}: {time.monotonic() - started:.0f} s", flush=True)


def main(only=None):
    made = deployed("single", lambda node: single.run(node, IMAGE, MISSIONS, PRECOMPUTED))
    if only == "single":
        return
    for name in MEASURED:
        one, two = (deployed("cluster", fan_out(name, made, workers)) for workers in (1, 2))
        print(f"{name}: {one / two:.2f} times as fast on two workers as on one")
    deployed("cluster", lambda all_of_it: cluster.run(
        cluster.Cluster(all_of_it, IMAGE, MISSIONS), made))  # fmt: skip


def fan_out(name, made, workers):
    """How long a precompute takes on so many workers, with an empty store."""
    return lambda all_of_it: cluster.precompute_time_s(
        cluster.Cluster(all_of_it, IMAGE, MISSIONS, workers), name, made
    )


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (Failed, OSError) as fault:
        sys.exit(f"FAILED: {fault}")
