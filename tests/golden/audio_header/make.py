"""Writes the audio files beside this script, and expected.json with what ffprobe says of them.

    apt-get install ffmpeg && python make.py

Each file is a 440 Hz sine of LENGTH_S seconds, a length that is no whole number of any codec's
packets.
"""

import json
import pathlib
import subprocess

HERE = pathlib.Path(__file__).parent
LENGTH_S = 0.537

# A 1x1 PNG, padded with zeros so that the ID3 tag around it passes the MP3 prober's buffers.
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de"
    "0000000c4944415478da63f8cfc0000003010100c9fe92ef0000000049454e44ae426082"
)

FILES = {
    "pcm16.wav": ["-c:a", "pcm_s16le"],
    "pcm8_8k.wav": ["-c:a", "pcm_u8", "-ar", "8000"],
    "pcm24_stereo.wav": ["-c:a", "pcm_s24le", "-ac", "2", "-ar", "8000"],
    "float.wav": ["-c:a", "pcm_f32le", "-ar", "8000"],
    "extensible_6ch.wav": ["-c:a", "pcm_s16le", "-ac", "6", "-ar", "4000"],
    "pcm16.aiff": ["-c:a", "pcm_s16be", "-ar", "22050"],
    "sine.flac": ["-c:a", "flac", "-ar", "22050"],
    "cbr_lame.mp3": ["-c:a", "libmp3lame", "-b:a", "64k"],
    "cbr_no_xing.mp3": ["-c:a", "libmp3lame", "-b:a", "64k", "-write_xing", "0"],
    "vbr_no_xing.mp3": ["-c:a", "libmp3lame", "-q:a", "2", "-write_xing", "0"],
    "mpeg2_22k.mp3": ["-c:a", "libmp3lame", "-b:a", "32k", "-ar", "22050", "-ac", "2"],
    "vorbis.ogg": ["-c:a", "libvorbis", "-q:a", "0"],
    "opus.opus": ["-c:a", "libopus", "-b:a", "24k"],
    "opus_stereo.ogg": ["-c:a", "libopus", "-b:a", "24k", "-ac", "2"],
    "aac.m4a": ["-c:a", "aac", "-b:a", "32k"],
    "aac_48k_stereo.m4a": ["-c:a", "aac", "-b:a", "32k", "-ar", "48000", "-ac", "2"],
    "aac.aac": ["-c:a", "aac", "-b:a", "32k"],
}


def run(*command):
    return subprocess.run(command, check=True, capture_output=True).stdout


def probe(path):
    answer = json.loads(
        run(
            "ffprobe", "-v", "error", "-select_streams", "a:0", "-of", "json",
            "-show_entries", "stream=codec_name,sample_rate,channels,duration", str(path),
        )
    )["streams"][0]
    return {
        "codec": answer["codec_name"],
        "sample_rate_hz": int(answer["sample_rate"]),
        "n_channels": answer["channels"],
        "duration_s": float(answer["duration"]),
    }


def syncsafe(number):
    return bytes((number >> shift) & 0x7F for shift in (21, 14, 7, 0))


def with_cover(mp3):
    """An ID3v2.4 tag with a 6 kB picture frame before the MPEG frames."""
    picture = b"\x00image/png\x00\x03\x00" + PNG + bytes(6000)
    frame = b"APIC" + syncsafe(len(picture)) + b"\x00\x00" + picture
    return b"ID3\x04\x00\x00" + syncsafe(len(frame)) + frame + mp3


def main():
    sine = f"sine=frequency=440:sample_rate=44100:duration={LENGTH_S}"
    for name, options in FILES.items():
        run(
            "ffmpeg", "-y", "-v", "error", "-f", "lavfi", "-i", sine, "-map_metadata", "-1",
            "-fflags", "+bitexact", "-flags:a", "+bitexact", *options, str(HERE / name),
        )
    (HERE / "cover.mp3").write_bytes(with_cover((HERE / "vbr_no_xing.mp3").read_bytes()))
    # As written into a pipe: ffmpeg cannot go back and fill in the lengths.
    piped = run(
        "ffmpeg", "-v", "error", "-f", "lavfi", "-i", sine, "-fflags", "+bitexact",
        "-ar", "8000", "-f", "wav", "-",
    )
    (HERE / "piped.wav").write_bytes(piped)
    names = sorted([*FILES, "cover.mp3", "piped.wav"])
    expected = {name: probe(HERE / name) for name in names}
    (HERE / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    main()
