#!/usr/bin/env python3
"""Builds the room `autodiff` alone, from nothing, and prints how long that took and what it needs.

    python benches/room.py [--profile dev|release]

A package is made in a temporary folder with the room, the part of `model` that it uses (the trait and
the parameters) and the versions of Cargo.toml; the crates must have been downloaded before.
"""

import argparse
import pathlib
import re
import subprocess
import tempfile
import time
import tomllib

ROOT = pathlib.Path(__file__).resolve().parent.parent
LIB = """\
#[path = "{src}/autodiff/mod.rs"]
pub mod autodiff;
pub mod model {{
    #[path = "{src}/model/graph.rs"]
    mod graph;
    #[path = "{src}/model/parameter.rs"]
    mod parameter;
    pub use graph::*;
    pub use parameter::*;
}}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--profile", default="dev")
    profile = parser.parse_args().profile
    manifest = tomllib.loads((ROOT / "Cargo.toml").read_text())
    sources = [*(ROOT / "src/autodiff").rglob("*.rs"), ROOT / "src/model/graph.rs"]
    text = "\n".join(path.read_text() for path in [*sources, ROOT / "src/model/parameter.rs"])
    used = {
        name: version
        for name, version in manifest["dependencies"].items()
        if re.search(rf"\b{name.replace('-', '_')}::", text)
    }
    with tempfile.TemporaryDirectory() as folder:
        package = pathlib.Path(folder)
        (package / "src").mkdir()
        (package / "src/lib.rs").write_text(LIB.format(src=ROOT / "src"))
        lines = [f'[package]\nname = "room"\nversion = "0.0.0"\nedition = "{manifest["package"]["edition"]}"']
        lines.append("[dependencies]")
        for name, wanted in used.items():
            table = wanted if isinstance(wanted, dict) else {"version": wanted}
            parts = []
            for key, value in table.items():
                written = str(value).lower() if isinstance(value, bool) else str(value).replace("'", '"')
                parts.append(f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {written}")
            lines.append(f"{name} = {{ {', '.join(parts)} }}")
        lines.append("[profile.dev]\nopt-level = 2")
        (package / "Cargo.toml").write_text("\n".join(lines) + "\n")
        (package / "Cargo.lock").write_bytes((ROOT / "Cargo.lock").read_bytes())
        build = ["cargo", "build", "--quiet", "--offline", "--profile", profile]
        started = time.monotonic()
        subprocess.run(build, cwd=package, check=True)
        cold_s = time.monotonic() - started
        (package / "src/lib.rs").write_text(LIB.format(src=ROOT / "src") + "// again\n")
        started = time.monotonic()
        subprocess.run(build, cwd=package, check=True)
        warm_s = time.monotonic() - started
        tree = ["cargo", "tree", "--offline", "--edges", "normal,build", "--prefix", "none"]
        found = subprocess.run(tree, cwd=package, check=True, stdout=subprocess.PIPE, text=True)
        crates = {line.split()[0] for line in found.stdout.splitlines() if line} - {"room"}
    n_lines = sum(len(path.read_text().splitlines()) for path in sources)
    print(f"profile {profile}: {len(crates)} crates ({len(used)} direct), {n_lines:,} lines")
    print(f"with its dependencies {cold_s:.1f} s, the room alone {warm_s:.1f} s")
    print(", ".join(sorted(crates)))


if __name__ == "__main__":
    main()
