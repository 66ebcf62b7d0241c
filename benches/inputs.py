#!/usr/bin/env python3
"""Reads a corpus of audio files as FFmpeg and libsndfile read them, and says what differs.

    make bench-inputs
    python benches/inputs.py --bin target/release/examples/audio-decoded --only mp3

The corpus is made here: excerpts of the demo's songs through every encoder that Debian offers (FFmpeg with LAME, shine,
libvorbis and libopus; oggenc, opusenc, flac, lame, twolame, wavpack, sox, speexenc), at many rates, channels, sample
formats and containers; the same files cut in the middle, with tags, garbage or another file before or behind them; the
cases of tests/data/audio_cases; and the samples of mutagen (its source package) and of the crate hound. A file counts as

  same       every sample as one of the references has it, or both refuse it
  length     the samples agree where both have some, and one has more of them at its start or end
  nearer     other samples than FFmpeg's, which are nearer to those that were encoded
  told       samples are missing, and `lost_s` and the summary say so
  refused    a codec or container that is not supported, named, with the way out: convert it
  refused, read by the reference   something else is said to be wrong with it
  DIFFERENT  a silent difference: other samples, or fewer, and no word
"""

import argparse
import collections
import concurrent.futures
import json
import pathlib
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile

import numpy as np
import soundfile

from machine import heading

ROOT = pathlib.Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "bench-inputs"
SONGS = ["gunroar/gr2.ogg", "kevin-macleod/vibe_ace.ogg", "frets-on-fire/metal_madness.ogg"]
SECONDS = 5
# Absolute differences that rounding explains, by the codec: lossless ones have none.
TOLERANCES = {"opus": 2e-3, "vorbis": 2e-5, "aac": 1e-4, "mp3": 2e-5, "mp2": 2e-5, "mp1": 2e-5}
LOSSLESS = 1.6e-7
# What every refusal of a format that is not supported tells its user to do.
UNSUPPORTED = "convert it"


def run(*command: object, allow: bool = False) -> subprocess.CompletedProcess:
    done = subprocess.run([str(word) for word in command], capture_output=True)
    if done.returncode != 0 and not allow:
        sys.exit(f"{' '.join(map(str, command))}: {done.stderr.decode(errors='replace')[-2000:]}")
    return done


def ffmpeg(*arguments: object, allow: bool = False) -> subprocess.CompletedProcess:
    return run("ffmpeg", "-nostdin", "-hide_banner", "-loglevel", "error", "-y", *arguments, allow=allow)


class Corpus:
    def __init__(self, folder: pathlib.Path):
        self.folder = folder

    def place(self, group: str, name: str) -> pathlib.Path:
        place = self.folder / group / name
        place.parent.mkdir(parents=True, exist_ok=True)
        return place

    def encode(self, wav: pathlib.Path, group: str, name: str, *arguments: object) -> None:
        """Encodes by FFmpeg; a combination that an encoder does not know is left out."""
        place = self.place(group, name)
        if not place.exists() and ffmpeg("-i", wav, *arguments, place, allow=True).returncode != 0:
            place.unlink(missing_ok=True)

    def by(self, group: str, name: str, *command: object) -> None:
        """Encodes by another program; `PLACE` stands for the file."""
        place = self.place(group, name)
        if not place.exists():
            done = run(*[place if word == "PLACE" else word for word in command], allow=True)
            if done.returncode != 0:
                place.unlink(missing_ok=True)

    def make(self) -> None:
        sources = self.folder / "sources"
        sources.mkdir(parents=True, exist_ok=True)
        for s, song in enumerate(SONGS):
            for rate, channels in ((44_100, 2), (48_000, 2), (44_100, 1), (22_050, 2), (16_000, 1), (8_000, 1)):
                wav = sources / f"{s}-{rate}-{channels}.wav"
                if not wav.exists():
                    ffmpeg("-ss", 3 + 4 * s, "-t", SECONDS + 0.137 * s, "-i", ROOT / "tests/data/music" / song,
                           "-ar", rate, "-ac", channels, "-c:a", "pcm_s16le", wav)
                self.lossy(wav, f"{s}-{rate}-{channels}")
                if s == 0:
                    self.lossless(wav, f"{s}-{rate}-{channels}")
        wide = sources / "0-96000-6.wav"
        if not wide.exists():
            ffmpeg("-i", sources / "0-48000-2.wav", "-ar", 96_000, "-ac", 6, "-c:a", "pcm_s24le", wide)
        self.lossless(wide, "0-96000-6")
        self.lossy(wide, "0-96000-6")
        self.damaged()
        self.foreign()

    def lossy(self, wav: pathlib.Path, tag: str) -> None:
        lame = ("lame", "--quiet")
        for name, flags in {
            "cbr128": ["-b", "128"], "cbr320": ["-b", "320"], "vbr0": ["-V", "0"], "vbr9": ["-V", "9"],
            "abr": ["--abr", "96"], "joint": ["-m", "j"], "stereo": ["-m", "s"], "forced": ["-m", "f"],
            "dual": ["-m", "d"], "mono": ["-m", "m"], "free": ["--freeformat", "-b", "160"], "notag": ["-t"],
            "noreservoir": ["--nores"], "crc": ["-p"], "low": ["-b", "32"], "allshort": ["--allshort"],
            "noshort": ["--noshort"], "id3v2": ["--add-id3v2", "--tt", "a title", "--ta", "a person"],
        }.items():
            self.by("mp3", f"lame-{name}-{tag}.mp3", *lame, *flags, wav, "PLACE")
        self.encode(wav, "mp3", f"shine-{tag}.mp3", "-c:a", "libshine", "-b:a", "128k")
        for name in ("m4a", "mp4", "mkv", "avi", "wav", "mov"):
            self.encode(wav, "mp3 in containers", f"mp3-{tag}.{name}", "-c:a", "libmp3lame")
        for bits in ("64", "192", "384"):
            self.by("mp2", f"twolame-{bits}-{tag}.mp2", "twolame", "--quiet", "-b", bits, wav, "PLACE")
        for bits in ("32k", "96k", "256k"):
            for name in ("aac", "m4a", "mp4", "mov", "ts"):
                self.encode(wav, "aac", f"aac-{bits}-{tag}.{name}", "-c:a", "aac", "-b:a", bits)
        for flags in ("-aac_tns 0", "-aac_pns 0", "-aac_ms 1", "-aac_is 0", "-profile:a aac_main", "-profile:a aac_ltp",
                      "-movflags +faststart", "-movflags frag_keyframe+empty_moov"):
            name = flags.replace(" ", "").replace("-", "").replace(":", "")
            self.encode(wav, "aac", f"{name}-{tag}.m4a", "-c:a", "aac", *flags.split())
        for quality in ("-1", "3", "10"):
            self.by("vorbis", f"oggenc{quality}-{tag}.ogg", "oggenc", "-Q", "-q", quality, "-o", "PLACE", wav)
        for name in ("ogg", "oga", "webm", "mkv"):
            self.encode(wav, "vorbis", f"libvorbis-{tag}.{name}", "-c:a", "libvorbis")
        for name, flags in {
            "default": [], "6": ["--bitrate", "6"], "24": ["--bitrate", "24"], "256": ["--bitrate", "256"],
            "cbr": ["--hard-cbr"], "2.5ms": ["--framesize", "2.5"], "60ms": ["--framesize", "60"],
            "speech": ["--speech"], "music": ["--music"],
        }.items():
            self.by("opus", f"opusenc-{name}-{tag}.opus", "opusenc", "--quiet", *flags, wav, "PLACE")
        for application in ("voip", "audio", "lowdelay"):
            for name in ("ogg", "webm", "mp4", "caf"):
                self.encode(wav, "opus", f"{application}-{tag}.{name}", "-c:a", "libopus", "-application", application)
        for codec, name in {
            "wmav1": "wma", "wmav2": "wma", "ac3": "ac3", "eac3": "eac3", "libspeex": "spx", "wavpack": "wv",
            "tta": "tta", "libgsm": "gsm", "adpcm_ms": "wav", "adpcm_ima_wav": "wav", "adpcm_yamaha": "wav",
            "libgsm_ms": "wav", "real_144": "ra", "g722": "g722", "dca": "dts", "truehd": "thd", "nellymoser": "flv",
            "adpcm_ima_qt": "aif", "sbc": "sbc",
        }.items():
            more = ("-strict", "-2") if codec in ("dca", "truehd") else ()
            self.encode(wav, "other codecs", f"{codec}-{tag}.{name}", "-c:a", codec, *more)
        self.by("other codecs", f"wavpack-{tag}.wv", "wavpack", "-q", "-y", wav, "-o", "PLACE")
        self.by("other codecs", f"speexenc-{tag}.spx", "speexenc", "--quiet", wav, "PLACE")

    def lossless(self, wav: pathlib.Path, tag: str) -> None:
        for level in (0, 5, 8):
            self.by("flac", f"flac{level}-{tag}.flac", "flac", "-s", "-f", f"-{level}", "-o", "PLACE", wav)
        for name, flags in {
            "block4608": ["--blocksize", "4608"], "block192": ["--blocksize", "192"], "ogg": ["--ogg"], "nopad": ["--no-padding"],
            "noseek": ["--no-seektable"], "lax": ["--lax", "-b", "32768"],
        }.items():
            ending = "oga" if name == "ogg" else "flac"
            self.by("flac", f"{name}-{tag}.{ending}", "flac", "-s", "-f", *flags, "-o", "PLACE", wav)
        self.encode(wav, "flac", f"s32-{tag}.flac", "-c:a", "flac", "-sample_fmt", "s32")
        for name in ("mka", "mp4", "caf"):
            self.encode(wav, "flac", f"flac-{tag}.{name}", "-c:a", "flac")
        for depth in ("s16p", "s32p"):
            for name in ("m4a", "caf", "mov"):
                self.encode(wav, "alac", f"alac-{depth}-{tag}.{name}", "-c:a", "alac", "-sample_fmt", depth)
        little = ["u8", "s16le", "s24le", "s32le", "f32le", "f64le", "alaw", "mulaw", "s64le"]
        big = ["s8", "s16be", "s24be", "s32be", "f32be", "f64be", "alaw", "mulaw"]
        for name, formats in {"wav": little, "w64": little, "aiff": big, "aif": ["s16le"], "au": big, "caf": big + little,
                              "mov": big}.items():
            for pcm in formats:
                self.encode(wav, "pcm", f"{pcm}-{tag}.{name}", "-c:a", f"pcm_{pcm}")
        self.encode(wav, "pcm", f"rf64-{tag}.wav", "-c:a", "pcm_s16le", "-rf64", "always")
        self.encode(wav, "pcm", f"bext-{tag}.wav", "-c:a", "pcm_s24le", "-write_bext", "1", "-metadata", "description=x")
        for name, flags in {"sox8.wav": ["-b", "8"], "sox24.wav": ["-b", "24"], "soxfloat.wav": ["-e", "float", "-b", "32"],
                            "sox8.aiff": ["-b", "8"], "sox24.aifc": ["-b", "24"], "sox.voc": [], "sox.svx": [], "sox.sf": [],
                            "sox.paf": []}.items():
            self.by("pcm", f"{tag}-{name}", "sox", wav, *flags, "PLACE")

    def damaged(self) -> None:
        """Cuts and joins some files of each group."""
        for group in ("mp3", "aac", "vorbis", "opus", "flac", "alac", "pcm"):
            found = sorted(p for p in (self.folder / group).iterdir() if "0-44100-2" in p.name)
            for path in found[:: max(1, len(found) // 6)]:
                data = path.read_bytes()
                other = found[0].read_bytes() if found[0].suffix == path.suffix else data
                for what, content in {
                    "half": data[: len(data) // 2], "twice": data + data, "joined": data + other,
                    "zeros": data + bytes(5000), "garbage": bytes(range(256)) * 9 + data,
                    "hole": data[: len(data) // 2] + bytes(3000) + data[len(data) // 2 + 3000:],
                    "id3": b"ID3\3\0\0\0\0\2\1" + bytes(257) + data,
                    "id3v1": data + b"TAG" + bytes(125),
                }.items():
                    place = self.place("damaged", f"{what}-{group}-{path.name}")
                    if not place.exists():
                        place.write_bytes(content)

    def foreign(self) -> None:
        """Fetches the samples of packages, and copies the cases."""
        for path in sorted((ROOT / "tests/data/audio_cases").iterdir()):
            if path.suffix not in (".json", ".py", ".md"):
                shutil.copy(path, self.place("cases", path.name))
        packages = self.folder / "packages"
        if not packages.is_dir():
            run(sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", ":all:", "--dest",
                packages, "mutagen==1.48.1")
        (archive,) = packages.glob("mutagen-*.tar.gz")
        with tarfile.open(archive) as tar:
            for member in tar.getmembers():
                if member.isfile() and "/tests/data/" in member.name:
                    self.place("mutagen", pathlib.Path(member.name).name).write_bytes(tar.extractfile(member).read())
        for path in sorted((pathlib.Path.home() / ".cargo/registry/src").glob("*/hound-*/testsamples/*.wav")):
            shutil.copy(path, self.place("hound", path.name))


def by_ffmpeg(path: pathlib.Path) -> tuple[np.ndarray, int, str] | None:
    """Returns the samples, mono, the rate and the codec, as FFmpeg has them."""
    probe = run("ffprobe", "-v", "error", "-select_streams", "a:0", "-show_entries",
                "stream=codec_name,sample_rate,channels", "-of", "json", path, allow=True)
    try:
        stream = json.loads(probe.stdout)["streams"][0]
        rate, channels = int(stream["sample_rate"]), int(stream["channels"])
    except (ValueError, KeyError, IndexError):
        return None
    if rate < 1 or channels < 1:
        return None
    if stream["codec_name"] == "opus":
        found = by_libopus(path)
        return None if found is None else (found, 48_000, "opus")
    done = ffmpeg("-i", path, "-map", "a:0", "-f", "f32le", "-c:a", "pcm_f32le", "-ar", rate, "-ac", channels, "-",
                  allow=True)
    samples = np.frombuffer(done.stdout[: len(done.stdout) // (4 * channels) * 4 * channels], dtype="<f4")
    if len(samples) == 0:
        return None
    return samples.reshape(-1, channels).astype(np.float64).mean(axis=1), rate, stream["codec_name"]


def by_libopus(path: pathlib.Path) -> np.ndarray | None:
    """Returns the samples of the packets as libopus has them: FFmpeg's own decoder of Opus resamples speech in its own way,
    and libopus within it clips."""
    with tempfile.TemporaryDirectory() as folder:
        packets, wav = pathlib.Path(folder) / "a.opus", pathlib.Path(folder) / "a.wav"
        if path.suffix in (".opus", ".ogg"):
            packets = path
        else:
            ffmpeg("-i", path, "-map", "a:0", "-c:a", "copy", packets, allow=True)
        run("opusdec", "--quiet", "--float", "--no-dither", "--rate", "48000", packets, wav, allow=True)
        found = by_libsndfile(wav) if wav.exists() else None
        return None if found is None else found[0]


def by_libsndfile(path: pathlib.Path) -> tuple[np.ndarray, int] | None:
    try:
        samples, rate = soundfile.read(path, dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, TypeError, ValueError):
        return None
    return (samples.astype(np.float64).mean(axis=1), rate) if len(samples) else None


def differs(own: np.ndarray, reference: np.ndarray, tolerance: float) -> str:
    """Returns how two signals differ: `same`, `length`, or by how much."""
    n = min(len(own), len(reference))
    worst = float(np.abs(own[:n] - reference[:n]).max()) if n else 0.0
    if worst <= tolerance:
        return "same" if len(own) == len(reference) else "length"
    start = shift(own, reference)
    a, b = own[max(-start, 0):], reference[max(start, 0):]
    n = min(len(a), len(b))
    if start and n > len(own) // 2 and float(np.abs(a[:n] - b[:n]).max()) <= tolerance:
        return "length"
    return f"by {worst:.2g}"


def shift(own: np.ndarray, reference: np.ndarray) -> int:
    """Returns by how many samples a signal's start lies behind that of another, at most 8,192 either way."""
    at = len(own) // 2
    part = own[at:at + 4096]
    low = max(0, at - 8192)
    around = reference[low:at + 4096 + 8192]
    if len(part) < 4096 or len(around) <= len(part):
        return 0
    n = 1 << (len(around) + len(part)).bit_length()
    match = np.fft.irfft(np.fft.rfft(around, n) * np.conj(np.fft.rfft(part, n)), n)[:len(around) - len(part) + 1]
    return int(np.argmax(match)) + low - at


def judge(path: pathlib.Path, told: dict, samples: pathlib.Path) -> tuple[str, str]:
    """Returns a file's class and what is to be said of it."""
    reference = by_ffmpeg(path)
    if "error" in told:
        if reference is None and by_libsndfile(path) is None:
            return "same", "both refuse it"
        codec = "" if reference is None else f"{reference[2]}, {len(reference[0])} samples; "
        if UNSUPPORTED in told["error"]:
            return "refused", codec + told["error"]
        return "refused, read by the reference", codec + told["error"]
    own = np.fromfile(samples, dtype="<f4").astype(np.float64)
    codec = reference[2] if reference else told["codec"].lower()
    tolerance = TOLERANCES.get(codec, LOSSLESS)
    said = []
    for name, found in (("FFmpeg", reference), ("libsndfile", by_libsndfile(path))):
        if found is None:
            continue
        how = differs(own, found[0], tolerance) if found[1] == told["sample_rate_hz"] else f"{found[1]} Hz"
        if how == "same":
            return "same", name
        said.append((how, f"{name}: {how}, {len(found[0])} samples, own {len(own)} at {told['sample_rate_hz']} Hz"))
    message = f"{codec}; " + "; ".join(text for _, text in said) + f"; {told['loss']}"
    if not said:
        return "read, by no reference", message
    if not told["is_whole"]:
        return "told", message
    if any(how == "length" for how, _ in said):
        return "length", message
    source = source_of(path)
    if source is not None and reference is not None:
        errors = [error(samples, source) for samples in (own, reference[0])]
        if errors[0] <= errors[1]:
            return "nearer", f"{message}; off the source by {errors[0]:.2g}, FFmpeg by {errors[1]:.2g} (root mean square)"
    return "DIFFERENT", message


def source_of(path: pathlib.Path) -> np.ndarray | None:
    """Returns what a file was encoded from, mono, where it is of the same rate."""
    tag = re.search(r"(\d-\d+-\d)(?=\.)", path.name)
    source = path.parents[1] / "sources" / f"{tag.group(1)}.wav" if tag else None
    if source is None or not source.exists():
        return None
    samples, rate = by_libsndfile(source)
    return samples if f"-{rate}-" in path.name else None


def error(samples: np.ndarray, source: np.ndarray) -> float:
    """Returns the root mean square error of a decoded signal, wherever it starts."""
    start = shift(samples, source)
    a, b = samples[max(-start, 0):], source[max(start, 0):]
    n = min(len(a), len(b))
    return float(np.sqrt(np.mean((a[:n] - b[:n]) ** 2))) if n else np.inf


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bin", type=pathlib.Path, required=True, help="the example audio-decoded")
    parser.add_argument("--out", type=pathlib.Path, default=OUT, help="where the corpus lies (default %(default)s)")
    parser.add_argument("--only", default="", help="groups whose name has this")
    parser.add_argument("--list", action="store_true", help="also print every file that is not the same")
    args = parser.parse_args()
    corpus = Corpus(args.out / "corpus")
    corpus.make()
    samples = args.out / "samples"
    counts: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
    notes = []
    for group in sorted(p for p in corpus.folder.iterdir() if p.name not in ("sources", "packages")):
        if args.only not in group.name:
            continue
        files = sorted(group.iterdir())
        samples.mkdir(exist_ok=True)
        lines = run(args.bin, samples, *files).stdout.decode().splitlines()
        with concurrent.futures.ThreadPoolExecutor() as pool:
            told = map(json.loads, lines)
            judged = list(pool.map(judge, files, told, (samples / f"{i}.f32" for i in range(len(files)))))
        for path, (kind, what) in zip(files, judged, strict=True):
            counts[group.name][kind] += 1
            notes.append((kind, f"{group.name}/{path.name}", what))
        print(f"{group.name}: {len(files)} files", file=sys.stderr, flush=True)
        shutil.rmtree(samples)
    version = run("ffmpeg", "-version").stdout.decode().split()[2]
    print(heading("inputs", [f"FFmpeg {version}", f"libsndfile {soundfile.__libsndfile_version__}"]))
    kinds = ["same", "length", "nearer", "told", "refused", "refused, read by the reference", "read, by no reference", "DIFFERENT"]
    print("| | files | " + " | ".join(kinds) + " |")
    print("|---" * (len(kinds) + 2) + "|")
    total: collections.Counter = collections.Counter()
    for name, found in sorted(counts.items()) + [("all", None)]:
        found = total if found is None else found
        total.update(found if found is not total else {})
        print(f"| {name} | {found.total()} | " + " | ".join(str(found[kind]) for kind in kinds) + " |")
    if args.list:
        for kind, name, what in sorted(notes):
            if kind != "same":
                print(f"\n{kind}: {name}: {what}", end="")
        print()


if __name__ == "__main__":
    main()
