#!/usr/bin/env python3
"""Cuts the demo library beside this script out of a folder of whole songs and captures.

    python3 make.py --check       compare the files with manifest.json (needs Python alone)
    python3 make.py FOLDER        make files, manifest.json and LICENSES.md again (needs ffmpeg)

FOLDER holds the sources under the names that FILES gives them; their digests must be those of
manifest.json, unless --new-sources says that they are meant to differ.
"""

import argparse
import hashlib
import json
import pathlib
import shutil
import subprocess
import sys
from dataclasses import dataclass

HERE = pathlib.Path(__file__).resolve().parent
MANIFEST = HERE / "manifest.json"
LICENSES = HERE / "LICENSES.md"
FOLDERS = ["phrases", "music"]
MAX_BYTES = 11_000_000


@dataclass
class Origin:
    """Where files came from, and what their authors ask."""

    package: str
    author: str
    licence: str
    text: str
    note: str = ""


CMU_LICENCE = "free for research and commercial use"
KENTA_CHO = ("Kenta Cho", "BSD-2-Clause", "licenses/BSD-2-Clause-Kenta-Cho.txt")
CC0 = ("CC0-1.0", "https://creativecommons.org/publicdomain/zero/1.0/")
SONIC_PI = "sonic-pi-samples 3.2.2~repack-8 (Debian)"


def loop(author: str, sound: str) -> Origin:
    source = f"https://freesound.org/people/{author}/sounds/{sound}/"
    return Origin(SONIC_PI, f"{author} ({source})", *CC0)


ORIGINS = {
    "cmu": Origin(
        "assimp-testmodels 5.2.5~ds0-1 (Debian)",
        "CMU Graphics Lab Motion Capture Database; BVH conversion by B. Hahne",
        CMU_LICENCE,
        "licenses/CMU-motion-capture.txt",
        "converted to 25 channels at 30 fps",
    ),
    "decentraland": Origin(
        "@dcl/wearable-preview 1.28.1 (npm)",
        "Decentraland",
        "Apache-2.0",
        "licenses/Apache-2.0.txt",
        "avatar emote, animated or retargeted rather than captured; "
        "the root of the GLB animation converted to 25 channels at 30 fps",
    ),
    "pybullet": Origin(
        "pybullet 3.2.7 (PyPI), pybullet_data/data/motions",
        "DeepMimic clips distributed with Bullet Physics",
        "Zlib",
        "licenses/Zlib-pybullet.txt",
        "converted to 25 channels at 30 fps",
    ),
    "mocapbank": Origin(
        "bvh_anim 0.4.0 (crates.io)",
        "MocapBank take distributed by George Burton",
        "MIT",
        "licenses/MIT-George-Burton.txt",
    ),
    "gunroar": Origin("gunroar-data 0.15.dfsg1-10 (Debian)", *KENTA_CHO),
    "mu-cade": Origin("mu-cade-data 0.11.dfsg1-13 (Debian)", *KENTA_CHO),
    "noiz2sa": Origin("noiz2sa-data 0.51a-13 (Debian)", *KENTA_CHO),
    "parsec47": Origin("parsec47-data 0.2.dfsg1-9 (Debian)", *KENTA_CHO),
    "rrootage": Origin("rrootage-data 0.23a-13 (Debian)", *KENTA_CHO),
    "titanion": Origin("titanion-data 0.3.dfsg1-8 (Debian)", *KENTA_CHO),
    "torus-trooper": Origin("torus-trooper-data 0.22.dfsg1-13 (Debian)", *KENTA_CHO),
    "frets-on-fire": Origin(
        "fretsonfire-songs-sectoid 1.dfsg-3.1 (Debian)",
        "Carlos Viola Iborra",
        "MIT",
        "licenses/MIT-Carlos-Viola-Iborra.txt",
        "song and guitar tracks mixed and encoded as Vorbis; beats from the tempo map of the "
        "chart, beat numbers assume 4/4 from the first beat",
    ),
    "kevin-macleod": Origin(
        "librosa 0.7.2 (PyPI), example data",
        'Kevin MacLeod, "Vibe Ace" (incompetech.com)',
        "CC-BY-3.0",
        "https://creativecommons.org/licenses/by/3.0/",
    ),
    "beatnet": Origin(
        "BeatNet 1.1.3 (PyPI), test data",
        "Mojtaba Heydari",
        "CC-BY-4.0",
        "https://creativecommons.org/licenses/by/4.0/",
        "bass drum at 120 beats per minute",
    ),
    "compus": loop("godspine", "212288"),
    "mika": loop("mika55", "188551"),
    "safari": loop("nemaavla", "318759"),
    "tabla": loop("lezaarth", "242591"),
}


@dataclass
class File:
    """One file to make: the first `cut_s` seconds of its source, or all of it."""

    path: str
    source: str
    origin: str
    cut_s: float | None = None


def phrase(name: str, source: str, origin: str) -> File:
    return File(f"phrases/motion/{name}/trajectory.npy", f"motion/{source}.npy", origin)


def song(origin: str, name: str, bpm: int | None = None) -> File:
    """With a tempo, 64 beats of the song, so that the cut can be looped."""
    cut_s = None if bpm is None else round(64 * 60 / bpm, 3)
    return File(f"music/{origin}/{name}.ogg", f"music/{origin}_{name}.ogg", origin, cut_s)


def one_shot(name: str) -> File:
    return File(f"music/sonic-pi/{name}.flac", f"music/loops/loop_{name}.flac", name)


CHARTED = "music/frets-on-fire/metal_madness"
CHARTED_CUT_S = 40.0

FILES = [
    phrase("cmu_01_01", "01_01", "cmu"),
    phrase("cmu_01_03", "01_03", "cmu"),
    phrase("decentraland_dance", "dcl_dance", "decentraland"),
    phrase("decentraland_fashion", "dcl_fashion", "decentraland"),
    phrase("decentraland_fashion_3", "dcl_fashion-3", "decentraland"),
    *[
        phrase(f"humanoid3d_{move}", f"humanoid3d_{move}", "pybullet")
        for move in ["cartwheel", "dance_a", "dance_b", "jump", "kick", "run", "spin", "walk"]
    ],
    File("phrases/motion/mocapbank/motion.bvh", "motion_raw/test_mocapbank.bvh", "mocapbank"),
    song("gunroar", "gr0", 146),
    song("gunroar", "gr2", 150),
    song("mu-cade", "mcd1", 150),
    song("mu-cade", "mcd2", 150),
    song("noiz2sa", "stg0", 150),
    song("noiz2sa", "stg00", 154),
    song("parsec47", "ptn0"),
    song("parsec47", "ptn1", 160),
    song("rrootage", "stg_a", 145),
    song("rrootage", "stg_b"),
    song("titanion", "ttn1", 150),
    song("torus-trooper", "tt1", 160),
    song("torus-trooper", "tt3", 160),
    File(f"{CHARTED}.ogg", "music/fof_metal_madness.ogg", "frets-on-fire", CHARTED_CUT_S),
    File(
        f"{CHARTED}.beats.txt", "music/fof_metal_madness.beats.txt", "frets-on-fire", CHARTED_CUT_S
    ),
    File(
        "music/kevin-macleod/vibe_ace.ogg",
        "music/vibe_ace_kevin_macleod.ogg",
        "kevin-macleod",
        24.0,
    ),
    File("music/beatnet/kick_120bpm.mp3", "music/808kick120bpm.mp3", "beatnet"),
    *[one_shot(name) for name in ["compus", "mika", "safari", "tabla"]],
]


def digest(path: pathlib.Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def make(file: File, source: pathlib.Path, target: pathlib.Path) -> str:
    """Writes one file and returns the command that cut it; empty for a plain copy."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if file.cut_s is None:
        shutil.copyfile(source, target)
        return ""
    if file.path.endswith(".beats.txt"):
        lines = source.read_text().splitlines(keepends=True)
        kept = [line for line in lines if float(line.split()[0]) < file.cut_s]
        target.write_text("".join(kept))
        return f"beats before {file.cut_s:g} s"
    # Packets are copied as they are; bitexact keeps times and random numbers out of the container.
    options = ["-map", "0:a", "-t", f"{file.cut_s:g}", "-c", "copy", "-fflags", "+bitexact"]
    command = ["ffmpeg", "-v", "error", "-y", "-i", str(source), *options, str(target)]
    subprocess.run(command, check=True, stdin=subprocess.DEVNULL)
    return " ".join(["ffmpeg", "-i", source.name, *options, target.name])


def make_all(folder: pathlib.Path, new_sources: bool) -> None:
    known = {}
    if MANIFEST.exists() and not new_sources:
        known = {f["source"]: f["source_sha256"] for f in json.loads(MANIFEST.read_text())["files"]}
    sources = {file.source: folder / file.source for file in FILES}
    missing = [name for name, path in sources.items() if not path.is_file()]
    if missing:
        sys.exit(f"{folder} lacks {', '.join(missing)}; name the folder that holds all sources")
    for name, path in sources.items():
        if known.get(name, digest(path)) != digest(path):
            sys.exit(
                f"{path} is not the file that manifest.json names; pass --new-sources to use it"
            )
    for name in FOLDERS:
        shutil.rmtree(HERE / name, ignore_errors=True)
    entries = []
    for file in FILES:
        source, target = sources[file.source], HERE / file.path
        cut = make(file, source, target)
        entries.append(
            {
                "path": file.path,
                "bytes": target.stat().st_size,
                "sha256": digest(target),
                "origin": file.origin,
                "source": file.source,
                "source_sha256": digest(source),
                "cut": cut,
            }
        )
    entries.sort(key=lambda entry: str(entry["path"]))
    MANIFEST.write_text(json.dumps({"files": entries}, indent=1) + "\n")
    LICENSES.write_text(licenses(entries))


def licenses(entries: list[dict]) -> str:
    text = [
        "# Licences of the demo library\n\n"
        "Written by `make.py`. Music and motion here were made by others, independently of each\n"
        "other: no motion belongs to any of the songs.\n\n"
        "> The data used in this project was obtained from mocap.cs.cmu.edu. The database was\n"
        "> created with funding from NSF EIA-0196217.\n\n"
        "The same captures serve as golden files: `../golden/motion/cmu_01_01.bvh` is the\n"
        "beginning of CMU subject 1 trial 1, `mocapbank.bvh` and `mocapbank_15fps.bvh` are the\n"
        "beginning of the test file of bvh_anim (MIT, © 2019 George Burton). The other BVH files\n"
        "there were drawn by the script beside them.\n"
    ]
    for name, origin in ORIGINS.items():
        own = [entry for entry in entries if entry["origin"] == name]
        place = (
            f"[text]({origin.text})" if origin.text.startswith("licenses/") else f"<{origin.text}>"
        )
        text.append(f"\n## {name}\n\n")
        text.append(f"- package: {origin.package}\n- author: {origin.author}\n")
        text.append(f"- licence: {origin.licence}, {place}\n")
        if origin.note:
            text.append(f"- changes: {origin.note}\n")
        text.append("\n| file | cut | SHA-256 |\n|---|---|---|\n")
        for entry in own:
            cut = f"`{entry['cut']}`" if entry["cut"] else "whole"
            text.append(f"| `{entry['path']}` | {cut} | `{entry['sha256']}` |\n")
    return "".join(text)


def check() -> None:
    entries = json.loads(MANIFEST.read_text())["files"]
    problems = []
    for entry in entries:
        path = HERE / entry["path"]
        if not path.is_file():
            problems.append(f"{entry['path']} is missing; restore it with git checkout")
        elif digest(path) != entry["sha256"]:
            problems.append(
                f"{entry['path']} differs from manifest.json; restore it, and look for a "
                "line-ending conversion if nobody edited it (see .gitattributes)"
            )
    named = {entry["path"] for entry in entries}
    for name in FOLDERS:
        for path in (HERE / name).rglob("*"):
            relative = path.relative_to(HERE).as_posix()
            if path.is_file() and relative not in named:
                problems.append(
                    f"{relative} is not in manifest.json; add it to make.py or remove it"
                )
    n_bytes = sum(entry["bytes"] for entry in entries)
    if n_bytes > MAX_BYTES:
        problems.append(f"the files have {n_bytes} bytes, more than {MAX_BYTES}; cut shorter")
    if LICENSES.read_text() != licenses(entries):
        problems.append("LICENSES.md does not follow from make.py and manifest.json; run make.py")
    for problem in problems:
        print(f"tests/data: {problem}", file=sys.stderr)
    if problems:
        sys.exit(1)
    print(f"tests/data: {len(entries)} files, {n_bytes / 1e6:.1f} MB, as manifest.json says")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", nargs="?", type=pathlib.Path, help="folder with the sources")
    parser.add_argument("--check", action="store_true", help="change nothing, compare")
    parser.add_argument("--new-sources", action="store_true", help="take sources of other content")
    arguments = parser.parse_args()
    if arguments.check == (arguments.folder is not None):
        parser.error("give either --check or the folder with the sources")
    if arguments.check:
        check()
    else:
        make_all(arguments.folder, arguments.new_sources)


if __name__ == "__main__":
    main()
