"""What a schema cannot see: names in manifests that must be those of other manifests.

Usage: manifests.py FILE... (needs PyYAML)
"""

import sys

import yaml


def resources(paths):
    for path in paths:
        with open(path, encoding="utf-8") as file:
            yield from yaml.safe_load_all(file)


def named(all_of_them, kind):
    return {one["metadata"]["name"] for one in all_of_them if one["kind"] == kind}


def covers(selector, labels):
    return selector.items() <= labels.items()


def faults(all_of_them):
    """Every name that leads nowhere."""
    workloads = [one for one in all_of_them if one["kind"] in ("Deployment", "StatefulSet")]
    pods = [one["spec"]["template"] for one in workloads]
    for one in workloads:
        yield from workload_faults(one, all_of_them)
    for one in all_of_them:
        name = f"{one['kind']} {one['metadata']['name']}"
        spec = one.get("spec", {})
        if one["kind"] in ("Service", "PodDisruptionBudget"):
            selector = spec["selector"].get("matchLabels", spec["selector"])
            chosen = [pod for pod in pods if covers(selector, pod["metadata"]["labels"])]
            if len(chosen) != 1:
                yield f"{name}: its selector chooses {len(chosen)} kinds of pods"
            wanted = {port["targetPort"] for port in spec.get("ports", [])}
            for port in wanted - {port for pod in chosen for port in port_names(pod)}:
                yield f"{name}: no pod of it has a port {port}"
        if one["kind"] == "NetworkPolicy":
            selector = spec["podSelector"].get("matchLabels", {})
            chosen = [pod for pod in pods if covers(selector, pod["metadata"]["labels"])]
            if not chosen:
                yield f"{name}: concerns no pod"
            ports = {port["port"] for way in spec.get("ingress", []) for port in way["ports"]}
            for port in ports - {port for pod in chosen for port in port_names(pod)}:
                yield f"{name}: no pod of it has a port {port}"
        if one["kind"] == "HorizontalPodAutoscaler":
            target = spec["scaleTargetRef"]
            if target["name"] not in named(all_of_them, target["kind"]):
                yield f"{name}: there is no {target['kind']} {target['name']}"


def workload_faults(one, all_of_them):
    name = f"{one['kind']} {one['metadata']['name']}"
    pod = one["spec"]["template"]
    if not covers(one["spec"]["selector"]["matchLabels"], pod["metadata"]["labels"]):
        yield f"{name}: its selector does not choose its own pods"
    if one["kind"] == "StatefulSet":
        if one["spec"]["serviceName"] not in named(all_of_them, "Service"):
            yield f"{name}: there is no Service {one['spec']['serviceName']}"
    maps, secrets = named(all_of_them, "ConfigMap"), named(all_of_them, "Secret")
    volumes = pod["spec"].get("volumes", [])
    for volume in volumes:
        if "configMap" in volume and volume["configMap"]["name"] not in maps:
            yield f"{name}: there is no ConfigMap {volume['configMap']['name']}"
    kept = {volume["name"] for volume in volumes} | {
        claim["metadata"]["name"] for claim in one["spec"].get("volumeClaimTemplates", [])
    }
    for container in pod["spec"]["containers"]:
        for source in container.get("envFrom", []):
            for key, known in (("configMapRef", maps), ("secretRef", secrets)):
                if key in source and source[key]["name"] not in known:
                    yield f"{name}: there is no {source[key]['name']}"
        for mount in container.get("volumeMounts", []):
            if mount["name"] not in kept:
                yield f"{name}: there is no volume {mount['name']}"
        for key in ("startupProbe", "readinessProbe", "livenessProbe"):
            port = container.get(key, {}).get("httpGet", {}).get("port")
            if port not in {None, *port_names(pod)}:
                yield f"{name}: {key}: there is no port {port}"


def port_names(pod):
    return [port["name"] for one in pod["spec"]["containers"] for port in one["ports"]]


if __name__ == "__main__":
    found = list(faults(list(resources(sys.argv[1:]))))
    for fault in found:
        print(fault)
    sys.exit(1 if found else 0)
