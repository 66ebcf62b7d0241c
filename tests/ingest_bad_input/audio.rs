//! Audio that is none, beats that are none, and files that do not fit each other.

use super::case::Case;
use crate::support::files::{coherent, features_npz, trajectory, wav, wav_of};

pub fn cases() -> Vec<Case> {
    [songs(), beats(), lengths()].into_iter().flatten().collect()
}

#[rustfmt::skip]
fn songs() -> Vec<Case> {
    let song = |id: &str, extension: &str, bytes: &[u8], kind, sentence| {
        Case::file(id, &format!("audio/{id}.{extension}"), bytes, kind, sentence)
    };
    vec![
        song("wav-empty", "wav", b"", "empty_file",
            "audio file is empty (0 bytes); the download or copy that made it failed, fetch it \
             again"),
        song("wav-is-a-web-page", "wav", b"<!DOCTYPE html>\n<title>Sign in</title>", "audio_header",
            "not audio: it starts with \"<!DOCTYPE html>\"; was an error page saved as audio?"),
        song("flac-is-an-error-message", "flac", b"{\"error\": 403}", "audio_header",
            "not audio: it starts with \"{\\\"error\\\": 403}\"; was an error message saved as \
             audio?"),
        song("wav-header-cut-short", "wav", &wav(0.5)[..30], "audio_header",
            "audio header cannot be read from 30 bytes that start with \"RIFFd\": it ends before a \
             known codec's header does; the file may be cut short, copy or download it again"),
        song("wav-of-0-hz", "wav", &wav_of(0, 1, &[0; 64]), "audio_header",
            "wav header gives its pcm_s16le track a sample rate of 0 Hz; encode the file again"),
        song("wav-of-0-channels", "wav", &wav_of(8_000, 0, &[0; 64]), "audio_header",
            "wav header gives its pcm_s16le track 0 channels; encode the file again"),
        song("wav-without-samples", "wav", &wav_of(44_100, 2, &[]), "audio_header",
            "wav file has 0 samples of pcm_s16le at 44100 Hz; the recording or conversion that \
             made it failed, make it again"),
        song("mp3-is-text", "mp3", b"the song is in the other folder\n", "audio_header",
            "not audio: it starts with \"the song is in the other\"; WAV, AIFF, FLAC, MP3, Ogg, MP4, \
             AAC, CAF and AU are read, was another format saved under the name .mp3?"),
        song("ogg-is-a-picture", "ogg", b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR", "audio_header",
            "not audio: it starts with bytes 89 50 4e 47 0d 0a 1a 0a; it is a PNG picture"),
        song("m4a-is-a-zip", "m4a", b"PK\x03\x04\x14\x00\x00\x00\x08\x00", "audio_header",
            "not audio: it starts with bytes 50 4b 03 04 14 00 00 00; it is a zip archive, unpack \
             it first"),
    ]
}

#[rustfmt::skip]
fn beats() -> Vec<Case> {
    let beside_a_song = |id: &str, bytes: &[u8], kind, sentence: &str| {
        let (song, beats) = (format!("audio/{id}.wav"), format!("beats/{id}.beats.txt"));
        let files = [(song, wav(0.7)), (beats.clone(), bytes.to_vec())];
        let start = if sentence.contains("{path}") { "" } else { "{path}: " };
        Case::files(id, files, &beats, kind, &format!("{start}{sentence}"))
    };
    vec![
        beside_a_song("beats-empty", b"", "empty_file",
            "{path} is empty; write one beat time in seconds per line"),
        beside_a_song("beats-not-utf-8", b"0.5\n1.0 \xff\xfe\n", "beats_format",
            "is not UTF-8 text; write one beat time in seconds per line"),
        beside_a_song("beats-not-numbers", b"0.5\none second\n", "beats_format",
            "beats line 2 reads `one second`, expected a time in seconds; write one beat per line \
             as `time_s` or `time_s beat_number`"),
        beside_a_song("beats-going-back", b"0.5\n1.5\n\n1.25\n", "beats_format",
            "beats line 4 reads `1.25`, expected a time later than the beat before; write one beat \
             per line as `time_s` or `time_s beat_number`"),
        beside_a_song("beats-only-one", b"# one\n0.5\n", "beats_format",
            "beats hold 1 beats, expected at least 2; a tempo needs two beat times"),
        beside_a_song("beats-without-a-downbeat", b"0.5 2\n1.0 3\n", "beats_format",
            "beats are numbered but none is number 1; number the downbeats 1 or number no beat"),
        beside_a_song("beats-number-out-of-range", b"0.5 1\n1.0 65\n", "beats_format",
            "beats line 2 reads `1.0 65`, expected a beat number from 1 to 64; write one beat per \
             line as `time_s` or `time_s beat_number`"),
        Case::file("beats-alone", "beats/beats-alone.beats.txt", "0.5\n1.0\n", "layout",
            "{path} stands alone, without audio, motion or features; add one of them or remove it"),
    ]
}

#[rustfmt::skip]
fn lengths() -> Vec<Case> {
    let motion = |id: &str| format!("motion/{id}/trajectory.npy");
    let (a, b, c) = ("lengths-of-motion-and-audio", "lengths-of-motion-and-features",
        "lengths-of-audio-and-features");
    vec![
        Case::files(a, [(motion(a), trajectory(&coherent(45, 1))),
                (format!("audio/{a}.wav"), wav(1.5336))],
            &motion(a), "length_mismatch",
            "audio is 1.53 s but motion is 1.50 s; they must agree within 1 frame (0.033 s)"),
        Case::files(b, [(motion(b), trajectory(&coherent(45, 1))),
                (format!("audio_features/{b}/features.npz"), features_npz(47))],
            &motion(b), "length_mismatch",
            "features is 1.57 s but motion is 1.50 s; they must agree within 1 frame (0.033 s)"),
        Case::files(c, [(format!("audio/{c}.wav"), wav(1.0)),
                (format!("audio_features/{c}/features.npz"), features_npz(28))],
            "", "length_mismatch",
            "audio is 1.00 s but features is 0.93 s; they must agree within 1 frame (0.033 s)"),
    ]
}
