//! Which audio files there are: the one list of file name extensions, and how codecs that are not
//! decoded are named.

/// File name extensions of the containers that are read, in lower case.
pub const READ_EXTENSIONS: [&str; 21] = [
    "aac", "aif", "aifc", "aiff", "au", "caf", "flac", "m4a", "m4b", "m4r", "mp3", "mp4", "mpga",
    "oga", "ogg", "opus", "rf64", "snd", "w64", "wav", "wave",
];

/// File name extensions of audio that is not read. Listing such files gives each a sentence of its
/// own, where leaving them out would lose them without a word.
pub const NAMED_EXTENSIONS: [&str; 15] = [
    "ac3", "amr", "ape", "dff", "dsf", "mka", "mp2", "mpc", "ra", "spx", "tta", "weba", "webm",
    "wma", "wv",
];

/// Returns whether a file name extension, in any case, is one of audio.
pub fn is_audio_extension(extension: &str) -> bool {
    let mut known = READ_EXTENSIONS.iter().chain(&NAMED_EXTENSIONS);
    known.any(|known| known.eq_ignore_ascii_case(extension))
}

/// Names the codec of a WAVE format tag (RFC 2361) whose samples are not read.
pub(super) fn wave_codec(tag: u16) -> String {
    let name = match tag {
        0x0002 => "Microsoft ADPCM",
        0x0011 => "IMA ADPCM",
        0x0031 => "GSM 6.10",
        0x0040 | 0x0045 | 0x0064 => "G.726 ADPCM",
        0x0050 => "MPEG audio layer II",
        0x0092 | 0x2000 => "AC-3",
        0x00ff | 0x1600..=0x1602 | 0x1610 => "AAC in RIFF",
        0x0160..=0x0163 => "Windows Media Audio",
        0x0270 => "ATRAC3",
        0x2001 => "DTS",
        0x566f | 0x674f..=0x6751 | 0x676f..=0x6771 => "Vorbis in RIFF",
        0x704f => "Opus in RIFF",
        0xf1ac => "FLAC in RIFF",
        tag => return format!("of a codec with the WAVE format tag 0x{tag:04x}"),
    };
    name.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_names_that_people_use_are_known_in_any_case() {
        for extension in ["aac", "oga", "mp4", "m4b", "mpga", "wave", "aifc", "FLAC", "Opus", "w64"]
        {
            assert!(is_audio_extension(extension), "{extension}");
        }
        // Not read, but not passed over either.
        for extension in ["wma", "wv", "webm"] {
            assert!(is_audio_extension(extension), "{extension}");
        }
        for extension in ["", "txt", "npy", "mp", "jpg", "mid"] {
            assert!(!is_audio_extension(extension), "{extension}");
        }
    }
}
