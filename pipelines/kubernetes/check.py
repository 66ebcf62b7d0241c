#!/usr/bin/env python3
"""Holds the manifests of this folder against the schema of the Kubernetes API, and against what a schema cannot say.

    make check-kubernetes

Prints a line for each manifest. Exit code 1 when one is wrong.
"""

import sys
from pathlib import Path

import kubernetes_validate
import yaml

# The oldest version in which everything that is used is stable, and the newest whose schema is at hand.
VERSIONS = ["1.33", kubernetes_validate.latest_version()]


def problems(manifest):
    """Returns what is wrong with a manifest, one sentence each."""
    for version in VERSIONS:
        try:
            kubernetes_validate.validate(manifest, version, strict=True)
        except kubernetes_validate.ValidationError as error:
            yield f"Kubernetes {version}: {error.message} at {list(error.path)}"
            return
    spec = manifest["spec"]
    pod = spec["template"]["spec"]
    [container] = pod["containers"]
    variables = {one["name"]: one.get("value") for one in container["env"]}
    n_shards = variables.get("JOB_COMPLETION_COUNT")
    if spec.get("completionMode") != "Indexed" or n_shards != str(spec["completions"]):
        yield f"JOB_COMPLETION_COUNT is {n_shards}, but there are {spec['completions']} completions"
    if not spec.get("backoffLimitPerIndex") or pod["restartPolicy"] != "Never":
        yield "FailIndex needs backoffLimitPerIndex and restartPolicy Never"
    stage = container["args"][0]
    named = [rule["onExitCodes"]["containerName"] for rule in spec["podFailurePolicy"]["rules"] if "onExitCodes" in rule]
    if set(named) != {container["name"]} or stage != container["name"]:
        yield f"containers are called {named}, {container['name']} and run {stage}"
    mounted = {mount["name"] for mount in container["volumeMounts"]}
    if mounted != {volume["name"] for volume in pod["volumes"]}:
        yield f"of the volumes {mounted} are mounted"


def main():
    folders = [Path(path) for path in sys.argv[1:]] or [Path(__file__).parent]
    files = sorted(path for folder in folders for path in folder.glob("*.yaml"))
    n_wrong = 0
    for path in files:
        found = list(problems(yaml.safe_load(path.read_text())))
        n_wrong += bool(found)
        print(f"{path.name}: {'; '.join(found) or 'as Kubernetes ' + ' and '.join(VERSIONS) + ' have it'}")
    if not files:
        print("no manifests were found", file=sys.stderr)
    return 1 if n_wrong or not files else 0


if __name__ == "__main__":
    sys.exit(main())
