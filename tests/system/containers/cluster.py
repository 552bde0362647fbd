"""Three NATS servers, two API nodes behind a balancer, two workers: killed one by one under load,
restarted under a closed loop, left without NATS, and asked afterwards what they remember."""

import json
import threading
import time
from datetime import datetime

from engine import (
    PORT,
    Command,
    Failed,
    answered,
    request,
    require,
    status_of,
    wait_until,
)
from pump import START, Pump, check_download, check_kept, problem, varied
from single import told

# What the second containers call the cluster.
BALANCER = f"http://balancer:{PORT}"
# How long what was killed stays away.
AWAY_S = 5
# Closed loops that last longer than the restart of both API nodes, and how many fly at once.
FLIGHTS = 2000
FLIGHTS_AT_ONCE = 8


class Cluster:
    def __init__(self, composition, image, missions, workers=2):
        self.composition = composition
        self.image = image
        self.missions = missions
        composition.up("--scale", f"worker={workers}")
        self.nats = [composition.container(f"nats-{number}") for number in (1, 2, 3)]
        self.api = composition.containers("api")
        self.workers = composition.containers("worker")
        self.balancer = composition.container("balancer")
        for node in [*self.api, *self.workers]:
            wait_ready(node)
        self.address = self.balancer.published()
        wait_until("an answer through the balancer", self.is_ready, 30)

    def is_ready(self):
        return status_of(self.address, "/readyz") == 200

    def command(self, *arguments):
        return Command(self.composition, self.image, self.missions, *arguments)

    def queue_leader(self):
        """The NATS server that leads the stream of work, and why it is the one."""
        for server in self.nats:
            known = answered((server.address(), 8222), "GET", "/jsz?streams=true&config=true")
            for account in known.get("account_details", []):
                for stream in account.get("stream_detail", []):
                    if stream["config"]["retention"] == "workqueue":
                        leader = stream["cluster"]["leader"]
                        return self.nats_named(leader), f"leader of {stream['name']}"
        raise Failed("no NATS server knows a stream of work")

    def nats_named(self, name):
        return self.nats[["nats-1", "nats-2", "nats-3"].index(name)]


def direct(node):
    return node.address(), PORT


def wait_ready(node, seconds=60):
    wait_until(f"{node} ready", lambda: status_of(direct(node), "/readyz") == 200, seconds)


def run(cluster, made):
    """`made`: by mission, id and digest of the artifact as a single node made it."""
    pump = Pump(cluster.address, cluster.missions)
    pump.start()
    killed_under_load(cluster, made)
    pump.stop()
    print(f"acknowledged: {pump.seen}; {pump.steps} steps, {pump.reads} reads")
    print(f"refused on the way, by HTTP status: {pump.refused}")
    require(pump.seen.plans and pump.seen.artifacts, "the callers were told nothing")
    for node in cluster.api:
        check_kept(pump.seen, direct(node))
    print(f"all of it is there, whole and the same, by {' and by '.join(map(str, cluster.api))}")

    restarted_under_a_closed_loop(cluster)
    without_nats(cluster, next(iter(pump.seen.artifacts)))
    for node in cluster.api:
        check_kept(pump.seen, direct(node))
    print("after that, too, everything that was acknowledged is there")


def precompute_time_s(cluster, name, made):
    """From the call to the end of a precompute that nothing disturbs."""
    artifact_id, content_sha256 = made[name]
    command = cluster.command("precompute", f"/missions/{name}.json", "--server", BALANCER)
    artifact = told(command.result(900)[0], name)
    require(artifact == made[name], f"{name} is not what a single node made: {content_sha256}")
    metadata = answered(cluster.address, "GET", f"/v1/operations/{artifact_id}")["metadata"]
    begin, end = (datetime.fromisoformat(metadata[key]) for key in ("createTime", "endTime"))
    seconds = (end - begin).total_seconds()
    print(f"{len(cluster.workers)} workers: {name} in {seconds:.1f} s, "
          f"{metadata['shardsTotal']} shards")  # fmt: skip
    return seconds


def killed_under_load(cluster, made):
    """Precomputes the missions while a worker, a NATS server and an API node are killed."""
    commands = {
        name: cluster.command("precompute", f"/missions/{name}.json", "--server", BALANCER)
        for name in made
    }
    identities = [artifact_id for artifact_id, _ in made.values()]
    comebacks = []
    for share, choose in [
        (0.05, lambda: (cluster.workers[0], "a worker")),
        (0.25, cluster.queue_leader),
        (0.45, lambda: (cluster.api[0], "an API node")),
    ]:
        done = wait_until(
            f"{share:.0%} of the shards", lambda: at_least(cluster, identities, share), 600
        )
        require(done < 1, "everything was done before all could be killed")
        victim, what = choose()
        victim.kill()
        print(f"killed at {done:.0%}: {victim} ({what})")
        comebacks.append(threading.Timer(AWAY_S, victim.start))
        comebacks[-1].start()
    for comeback in comebacks:
        comeback.join()
    for node in cluster.api:
        wait_ready(node)
    for name, command in commands.items():
        printed, said = command.result(900)
        artifact = told(printed, name)
        require(artifact == made[name], f"{name} is not what a single node made: {made[name]}")
        print(f"{name} survived: byte-identical; {retries(said)}")
        for node in cluster.api:
            check_download(direct(node), *artifact)


def at_least(cluster, identities, share):
    """How much of all operations is done, once it is as much as `share`; None before."""
    parts = []
    for artifact_id in identities:
        try:
            status, content = request(cluster.address, "GET", f"/v1/operations/{artifact_id}")
        except OSError:
            return None
        if status != 200:
            return None
        operation = json.loads(content)
        parts.append(1 if operation["done"] else operation["metadata"]["fractionDone"])
    done = sum(parts) / len(parts)
    return done if done >= share else None


def retries(said):
    """What a command said of calls it had to repeat."""
    told_so = [line for line in said.splitlines() if line.startswith("tried again")]
    return told_so[0] if told_so else "tried again 0 times"


def restarted_under_a_closed_loop(cluster):
    """Restarts the API nodes, one after the other, while flights go on through the balancer."""
    flights = [
        "simulate", "/missions/envisat.json", "--runs", str(FLIGHTS), "--seed", "1",
        "--concurrency", str(FLIGHTS_AT_ONCE), "--format", "json", "--no-pictures",
    ]  # fmt: skip
    command = cluster.command(*flights, "--server", BALANCER)
    time.sleep(3)
    for node in cluster.api:
        require_under_way(command)
        code = node.stop()
        require(code == 0, f"{node} ended with {code}")
        node.start()
        wait_ready(node)
        wait_until("the balancer to see it", lambda: servers_up(cluster) == len(cluster.api), 30)
        print(f"restarted under {FLIGHTS_AT_ONCE} closed loops: {node}")
    require_under_way(command)
    printed, said = command.result(600)
    undisturbed, _ = cluster.command(*flights).result(600)
    report, expected = json.loads(printed), json.loads(undisturbed)
    for one in (report, expected):
        # All that depends on the clock.
        del one["step_latency_ms"]
    require(report == expected, "the flights are not those of a node that was left alone")
    print(f"{report['steps']} steps in {FLIGHTS} flights, none failed, the same as undisturbed; "
          f"{retries(said)}")  # fmt: skip


def require_under_way(command):
    if not command.runs():
        # Says what was wrong, if something was.
        command.result(1)
        raise Failed("the flights were over before the restart was")


def servers_up(cluster):
    """How many nodes the balancer takes for ready."""
    status, content = request((cluster.balancer.address(), 8404), "GET", "/metrics")
    require(status == 200, f"the balancer's metrics: {status}")
    line = 'haproxy_backend_active_servers{proxy="ready"} '
    return sum(int(text.removeprefix(line)) for text in content.decode().splitlines()
               if text.startswith(line))  # fmt: skip


def without_nats(cluster, artifact_id):
    """All NATS servers are gone: what is in memory is still flown, and all recovers by itself."""
    step = {"artifactId": artifact_id, "measurement": START}
    mission = problem(cluster.missions / "double_integrator.json")
    new = {"problem": varied(mission, 77.0)}
    before = [answered(direct(node), "POST", "/v1/step", step) for node in cluster.api]
    require(all(answer == before[0] for answer in before), "two nodes, two answers")
    for server in cluster.nats:
        server.kill()
    print("killed:", ", ".join(map(str, cluster.nats)))
    for node in cluster.api:
        wait_until(
            f"{node} saying it is not ready", lambda: status_of(direct(node), "/readyz") == 503, 60
        )
        answer = answered(direct(node), "POST", "/v1/step", step)
        require(answer == before[0], f"{node} answers otherwise without NATS")
        status, content = request(direct(node), "POST", "/v1/precompute", new)
        refusal = json.loads(content)
        require(status == 503 and refusal["message"], f"Precompute by {node}: {status} {refusal}")
        print(f"{node} without NATS: /readyz 503, the step is the same, Precompute 503:",
              refusal["message"])  # fmt: skip
    wait_until("the balancer to find out", lambda: servers_up(cluster) == 0, 30)
    require(answered(cluster.address, "POST", "/v1/step", step) == before[0],
            "the balancer does not let the step through")  # fmt: skip
    for server in cluster.nats:
        server.start()
    for node in [*cluster.api, *cluster.workers]:
        wait_ready(node, 120)
    wait_until("the balancer to find out", lambda: servers_up(cluster) == len(cluster.api), 30)
    operation = answered(cluster.address, "POST", "/v1/precompute", new)
    ended = wait_until(
        "the precompute that was refused",
        lambda: ended_operation(cluster.address, operation["name"]),
        60,
    )
    require("response" in ended, f"the precompute that was refused: {ended}")
    print("NATS is back: all nodes are ready, and the precompute that was refused is done")


def ended_operation(address, name):
    operation = answered(address, "GET", f"/v1/{name}")
    return operation if operation["done"] else None
