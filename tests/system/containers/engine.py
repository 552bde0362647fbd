"""Containers, and the answers of what runs in them."""

import http.client
import json
import os
import shutil
import subprocess
import time

# Where a node listens in its container.
PORT = 7440
# Label of commands that run beside a composition.
COMMAND_OF = "vbar.test.command-of"


class Failed(Exception):
    """A promise that was not kept."""


def require(holds, what):
    if not holds:
        raise Failed(what)


def output(*command, **options):
    """What a command prints; `Failed` with its complaint if it does not end well."""
    ended = subprocess.run(command, capture_output=True, text=True, check=False, **options)
    if ended.returncode != 0:
        raise Failed(f"{' '.join(command)}: exit {ended.returncode}: {ended.stderr.strip()}")
    return ended.stdout.strip()


def docker(*arguments):
    return output("docker", *arguments)


def wait_until(what, condition, seconds):
    """The first true answer of `condition`, or `Failed` once `seconds` have passed."""
    until = time.monotonic() + seconds
    while True:
        answer = condition()
        if answer:
            return answer
        if time.monotonic() > until:
            raise Failed(f"not within {seconds} s: {what}")
        time.sleep(0.2)


class Container:
    def __init__(self, name, identity):
        self.name = name
        self.id = identity

    def __str__(self):
        return self.name

    def inspect(self, template):
        return docker("inspect", "--format", template, self.id)

    def address(self):
        """Its own, which changes when it starts."""
        return self.inspect("{{range .NetworkSettings.Networks}}{{.IPAddress}}{{end}}")

    def published(self):
        """Host and port by which this machine reaches it."""
        host, _, port = docker("port", self.id, f"{PORT}/tcp").splitlines()[0].rpartition(":")
        return host, int(port)

    def kill(self):
        docker("kill", "--signal", "KILL", self.id)

    def start(self):
        docker("start", self.id)

    def stop(self):
        """Tells it to end; its exit code."""
        docker("stop", "--time", "25", self.id)
        return int(self.inspect("{{.State.ExitCode}}"))

    def is_healthy(self):
        return self.inspect("{{.State.Health.Status}}") == "healthy"

    def wait_healthy(self, seconds=60):
        wait_until(f"{self} healthy", self.is_healthy, seconds)

    def logs(self):
        ended = subprocess.run(
            ["docker", "logs", "--tail", "30", self.id], capture_output=True, text=True, check=False
        )
        return ended.stdout + ended.stderr


class Composition:
    """Everything of one compose file, on images that are here already."""

    def __init__(self, project, file, images):
        self.project = project
        # Both are the same program by another name and age.
        known = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
        tool = ["docker", "compose"] if known.returncode == 0 else ["docker-compose"]
        require(shutil.which(tool[0]), "neither docker compose nor docker-compose is here")
        self.command = [*tool, "--project-name", project, "--file", file]
        # Any free port of this machine.
        self.environment = {**os.environ, **images, "PORT": ""}

    def compose(self, *arguments):
        return output(*self.command, *arguments, env=self.environment)

    def up(self, *arguments):
        self.compose("up", "--detach", "--no-build", *arguments)

    def down(self):
        """Leaves nothing behind, commands that still run included."""
        label = f"label={COMMAND_OF}={self.project}"
        commands = docker("ps", "--all", "--quiet", "--filter", label)
        for identity in commands.split():
            docker("rm", "--force", identity)
        self.compose("down", "--volumes", "--timeout", "5")

    def network(self):
        return f"{self.project}_default"

    def containers(self, service):
        """Those of a service that run, in their order."""
        found = [
            (docker("inspect", "--format", "{{.Name}}", identity).lstrip("/"), identity)
            for identity in self.compose("ps", "--quiet", service).split()
        ]
        return [Container(name, identity) for name, identity in sorted(found)]

    def container(self, service):
        (only,) = self.containers(service)
        return only

    def everything(self):
        label = f"label=com.docker.compose.project={self.project}"
        lines = docker("ps", "--all", "--filter", label, "--format", "{{.Names}} {{.ID}}")
        return [Container(*line.split()) for line in sorted(lines.splitlines())]


class Command:
    """The command `vbar` in a container of its own beside those of a composition."""

    def __init__(self, composition, image, missions, *arguments):
        self.arguments = arguments
        # What a node's image has of a writable root is nothing, so nothing may want it.
        self.process = subprocess.Popen(
            ["docker", "run", "--rm", "--read-only", "--cap-drop", "ALL", "--no-healthcheck"]
            + ["--network", composition.network(), "--volume", f"{missions}:/missions:ro"]
            + ["--label", f"{COMMAND_OF}={composition.project}"]
            + [image, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def runs(self):
        return self.process.poll() is None

    def result(self, seconds):
        """What it printed, and what it said beside; `Failed` if it did not end well in time."""
        try:
            printed, said = self.process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise Failed(f"vbar {' '.join(self.arguments)}: not within {seconds} s") from None
        code = self.process.returncode
        require(code == 0, f"vbar {' '.join(self.arguments)}: exit {code}: {said.strip()}")
        return printed, said


def request(address, method, path, body=None, timeout_s=30):
    """Status and body of one HTTP call; `OSError` if nobody answers."""
    connection = http.client.HTTPConnection(*address, timeout=timeout_s)
    try:
        headers = {"content-type": "application/json"} if body is not None else {}
        text = json.dumps(body) if body is not None else None
        connection.request(method, path, text, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    except http.client.HTTPException as fault:
        raise OSError(f"{method} {path}: {fault!r}") from fault
    finally:
        connection.close()


def fetched(address, method, path, body=None):
    """The body of the answer; `Failed` if it is an error. A node that is busy is asked again."""

    def once():
        status, content = request(address, method, path, body)
        return None if status == 429 else (status, content)

    status, content = wait_until(f"an answer to {method} {path}", once, 60)
    require(status == 200, f"{method} {path}: {status}: {content[:500]!r}")
    return content


def answered(address, method, path, body=None):
    """The same as JSON."""
    return json.loads(fetched(address, method, path, body))


def status_of(address, path):
    """Status of a GET; None if nobody answers."""
    try:
        return request(address, "GET", path, timeout_s=3)[0]
    except OSError:
        return None
