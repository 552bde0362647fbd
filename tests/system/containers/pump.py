"""Callers that never rest, and remember what they were told."""

import copy
import hashlib
import json
import threading
import time

from engine import Failed, answered, fetched, request, require

# Where the double integrator starts, far enough from home for a whole approach.
START = {"linear": {"components": [20.0, 0.0]}}


class Acknowledged:
    """What the nodes said they have, by its name, with the digest of its content if known."""

    def __init__(self):
        self.plans = {}
        self.operations = set()
        self.artifacts = {}

    def __str__(self):
        return (
            f"{len(self.plans)} plans, {len(self.operations)} operations, "
            f"{len(self.artifacts)} artifacts"
        )


class Pump:
    """Uploads plans, starts small precomputes, steps on their artifacts and reads it all back,
    through one address, on a thread of its own."""

    def __init__(self, address, missions):
        self.address = address
        self.plan_problem = problem(missions / "prisma.json")
        self.loop_problem = problem(missions / "double_integrator.json")
        self.seen = Acknowledged()
        self.steps = 0
        self.reads = 0
        self.refused = {}
        self.fault = None
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self.run, daemon=True)

    def start(self):
        self.thread.start()

    def stop(self):
        self.ended.set()
        self.thread.join(60)
        require(not self.thread.is_alive(), "a caller still waits for its answer")
        if self.fault:
            raise Failed(f"a caller ended: {self.fault}")

    def run(self):
        count = 0
        try:
            while not self.ended.is_set():
                count += 1
                self.turn(count)
                time.sleep(0.1)
        except Failed as fault:
            self.fault = fault

    def turn(self, count):
        weight = 1 + count / 1024
        made = self.call("POST", "/v1/precompute", {"problem": varied(self.loop_problem, weight)})
        if made:
            name = made["name"]
            self.seen.operations.add(name)
            self.step(name.rsplit("/", 1)[-1])
        if count % 4 == 0:
            self.plan(varied(self.plan_problem, weight))

    def step(self, artifact_id):
        """A step by the artifact's name, once it is there."""
        body = {"artifactId": artifact_id, "measurement": START, "omitPrediction": True}
        for _ in range(20):
            status, answer = self.asked("POST", "/v1/step", body)
            if status == 200:
                require(answer["certificate"]["passed"], f"a certificate that fails: {answer}")
                self.steps += 1
                self.remember(artifact_id, answer["provenance"]["contentSha256"])
                return
            if self.ended.wait(0.2):
                return

    def plan(self, mission):
        """Has a plan made, and brings it as if it were another's."""
        made = self.call("POST", "/v1/plans:compute", {"problem": mission})
        if not made:
            return
        document = {"problem": mission, "plan": made["plan"]}
        kept = self.call("POST", "/v1/plans", {"document": document})
        if not kept:
            return
        require(kept["planId"] == made["planId"], "the same plan has two names")
        read = self.call("GET", f"/v1/plans/{kept['planId']}")
        self.seen.plans[kept["planId"]] = read and digest(read["document"])

    def remember(self, artifact_id, content_sha256):
        known = self.seen.artifacts.setdefault(artifact_id, content_sha256)
        require(known == content_sha256, f"artifact {artifact_id} has changed")

    def call(self, method, path, body=None):
        """The answer, or None if the world was in the way; any other refusal is a fault."""
        status, answer = self.asked(method, path, body)
        if status == 200:
            self.reads += method == "GET"
            return answer
        require(status in (None, 429, 502, 503, 504), f"{method} {path}: {status}: {answer}")
        return None

    def asked(self, method, path, body):
        try:
            status, content = request(self.address, method, path, body, timeout_s=15)
        except OSError:
            status, content = None, b""
        if status != 200:
            self.refused[status] = self.refused.get(status, 0) + 1
            return status, content[:500]
        return status, json.loads(content)


def problem(path):
    return json.loads(path.read_text(encoding="utf-8"))["problem"]


def varied(mission, fuel_weight):
    """A mission like this one, of another name."""
    changed = copy.deepcopy(mission)
    (method,) = changed.values()
    method["fuelWeight"] = fuel_weight
    return changed


def digest(document):
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def check_kept(seen, address):
    """Everything that was acknowledged is there, whole and the same, as this node sees it."""
    for plan_id, content in seen.plans.items():
        kept = answered(address, "GET", f"/v1/plans/{plan_id}")
        require(content in (None, digest(kept["document"])), f"plan {plan_id} has changed")
    for name in seen.operations:
        operation = answered(address, "GET", f"/v1/{name}")
        require("error" not in operation, f"{name} has failed: {operation}")
    for artifact_id, content_sha256 in seen.artifacts.items():
        check_download(address, artifact_id, content_sha256)


def check_download(address, artifact_id, content_sha256):
    content = fetched(address, "GET", f"/v1/artifacts/{artifact_id}:download")
    found = hashlib.sha256(content).hexdigest()
    require(found == content_sha256, f"artifact {artifact_id} has the digest {found}")
