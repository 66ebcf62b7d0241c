//! What symphonia does not tell of an MP4 track: the part that its edit list or iTunes' tag asks to play, and the
//! byte order of uncompressed samples.
//!
//! Encoders put a delay before the first sample and fill the last packet up. Symphonia 0.6.1 reads
//! the edit list (ISO/IEC 14496-12 section 8.6.6) and ignores it. Of several edits, as in a video
//! cut without re-encoding, the first one counts.

use std::io::{self, Read, Seek, SeekFrom};

/// Bytes of a text that are read: iTunes' has 130.
const MAX_TEXT_BYTES: u64 = 256;

/// Bytes of a sample description that are read: a sound description with its extensions has some 150.
const MAX_DESCRIPTION_BYTES: u64 = 1024;

/// Levels of nesting that are read: moov, udta, meta, ilst and the tag are five.
const MAX_DEPTH: u32 = 8;

/// Tracks that are read.
const MAX_TRACKS: usize = 256;

/// What one file says of its tracks' samples.
#[derive(Debug, Default, PartialEq)]
pub(in crate::audio) struct Edits {
    /// Units of a second in which edits' durations are.
    movie_timescale: u32,
    tracks: Vec<TrackEdit>,
    /// Encoder delay and sample count from iTunes' gapless tag.
    itunes: Option<(u64, u64)>,
}

#[derive(Debug, Default, PartialEq)]
struct TrackEdit {
    id: u32,
    /// Units of a second in which the edit's start is.
    timescale: u32,
    /// Start in the media and duration in the movie; duration 0 means to the end.
    edit: Option<(u64, u64)>,
    /// Whether samples of 24, 32 or 64 bits have their high byte first.
    is_big_endian: bool,
}

impl Edits {
    /// Reads the edits of an MP4 file; leaves `input` anywhere.
    pub fn read(input: &mut (impl Read + Seek), n_bytes: u64) -> io::Result<Self> {
        let mut edits = Self::default();
        visit(input, 0, n_bytes, MAX_DEPTH, &mut edits)?;
        Ok(edits)
    }

    /// Returns whether the samples of a track of 24, 32 or 64 bits each have their high byte first.
    ///
    /// QuickTime's `in24`, `in32`, `fl32` and `fl64` have, unless an atom `enda` holds 1 (QuickTime File Format,
    /// "Sound sample description extensions"). Symphonia 0.6.1 takes them all for little-endian.
    pub fn is_big_endian(&self, id: u32) -> bool {
        self.tracks.iter().any(|track| track.id == id && track.is_big_endian)
    }

    /// Returns the first sample to play and the one after the last, as far as they are stated.
    ///
    /// `n_samples` is the sum of the packets' durations: more exact than an edit's duration, which
    /// often is in milliseconds.
    pub fn of_track(
        &self,
        id: u32,
        sample_rate_hz: u32,
        n_samples: Option<u64>,
    ) -> Option<(u64, u64)> {
        let samples = |units: u64, timescale: u32| {
            let samples = u128::from(units) * u128::from(sample_rate_hz);
            let half = u128::from(timescale) / 2;
            u64::try_from((samples + half).checked_div(u128::from(timescale))?).ok()
        };
        let track = self.tracks.iter().find(|track| track.id == id)?;
        if let Some((start, duration)) = track.edit {
            let start = samples(start, track.timescale)?;
            let duration = samples(duration, self.movie_timescale)?;
            if duration == 0 {
                return Some((start, u64::MAX));
            }
            let last = n_samples.filter(|&n| n > start).unwrap_or(u64::MAX);
            return Some((start, start.saturating_add(duration).min(last)));
        }
        let (delay, n_samples) = self.itunes?;
        Some((delay, delay.saturating_add(n_samples)))
    }
}

/// Walks the atoms in a range of the file, into those that lead to edits.
fn visit(
    input: &mut (impl Read + Seek),
    mut start: u64,
    end: u64,
    depth: u32,
    edits: &mut Edits,
) -> io::Result<()> {
    let Some(depth) = depth.checked_sub(1) else { return Ok(()) };
    // An atom has a head of 8 bytes, so the walk ends after at most n_bytes / 8 steps.
    while start + 8 <= end {
        input.seek(SeekFrom::Start(start))?;
        let [s0, s1, s2, s3, name @ ..] = array::<8>(input)?;
        let (size, head_bytes) = match u32::from_be_bytes([s0, s1, s2, s3]) {
            0 => (end - start, 8),
            1 if start + 16 <= end => (u64::from_be_bytes(array(input)?), 16),
            size => (u64::from(size), 8),
        };
        let next = start.saturating_add(size);
        if size < head_bytes || next > end {
            break;
        }
        let content = start + head_bytes;
        match &name {
            b"trak" if edits.tracks.len() < MAX_TRACKS => {
                edits.tracks.push(TrackEdit::default());
                visit(input, content, next, depth, edits)?;
            }
            b"moov" | b"edts" | b"mdia" | b"minf" | b"stbl" | b"udta" | b"ilst" => {
                visit(input, content, next, depth, edits)?;
            }
            b"meta" if next - content >= 4 => visit(input, content + 4, next, depth, edits)?,
            b"----" => itunes_tag(input, content, next, edits)?,
            b"stsd" => byte_order(input, next - content, edits)?,
            b"mvhd" | b"tkhd" | b"mdhd" | b"elst" if next - content >= 16 => {
                number(input, &name, next - content, edits)?;
            }
            _ => {}
        }
        start = next;
    }
    Ok(())
}

/// Reads a header atom or edit list, of a version that has times in 4 or in 8 bytes.
fn number(
    input: &mut (impl Read + Seek),
    name: &[u8; 4],
    n_bytes: u64,
    edits: &mut Edits,
) -> io::Result<()> {
    let [version, ..] = array::<4>(input)?;
    let long = version == 1;
    let time = |input: &mut _| -> io::Result<u64> {
        Ok(if long { u64::from_be_bytes(array(input)?) } else { u64::from(word(input)?) })
    };
    if name == b"elst" {
        let n_entries = word(input)?.min((n_bytes / 12) as u32);
        for _ in 0..n_entries {
            if n_bytes < if long { 28 } else { 20 } {
                break;
            }
            let duration = time(input)?;
            let media_time = time(input)?;
            word(input)?;
            let empty = media_time == if long { u64::MAX } else { u64::from(u32::MAX) };
            if let (false, Some(track)) = (empty, edits.tracks.last_mut()) {
                track.edit.get_or_insert((media_time, duration));
                break;
            }
        }
        return Ok(());
    }
    // Creation and modification time.
    time(input)?;
    time(input)?;
    let value = word(input)?;
    match (name, edits.tracks.last_mut()) {
        (b"mvhd", _) => edits.movie_timescale = value,
        (b"tkhd", Some(track)) => track.id = value,
        (b"mdhd", Some(track)) => track.timescale = value,
        _ => {}
    }
    Ok(())
}

/// Reads the byte order out of a sample description: version and flags, a count, and the first entry.
fn byte_order(input: &mut impl Read, n_bytes: u64, edits: &mut Edits) -> io::Result<()> {
    let mut entry = Vec::new();
    input.take(n_bytes.min(MAX_DESCRIPTION_BYTES)).read_to_end(&mut entry)?;
    let is_wide = matches!(entry.get(12..16), Some(b"in24" | b"in32" | b"fl32" | b"fl64"));
    let enda = entry.windows(6).find(|bytes| bytes.starts_with(b"enda"));
    if let Some(track) = edits.tracks.last_mut() {
        track.is_big_endian = is_wide && enda.is_none_or(|enda| enda[4..] == [0, 0]);
    }
    Ok(())
}

/// Reads a free-form tag: atoms `mean` and `name` that name it, and `data`.
fn itunes_tag(
    input: &mut (impl Read + Seek),
    mut start: u64,
    end: u64,
    edits: &mut Edits,
) -> io::Result<()> {
    let mut is_gapless = false;
    while start + 8 <= end {
        input.seek(SeekFrom::Start(start))?;
        let [s0, s1, s2, s3, name @ ..] = array::<8>(input)?;
        let size = u64::from(u32::from_be_bytes([s0, s1, s2, s3]));
        if size < 8 || start + size > end {
            break;
        }
        let mut text = Vec::new();
        input.take((size - 8).min(MAX_TEXT_BYTES)).read_to_end(&mut text)?;
        if &name == b"name" {
            is_gapless = text.ends_with(b"iTunSMPB");
        } else if &name == b"data" && is_gapless {
            // Hexadecimal: a zero, delay, padding, sample count, zeros.
            let text = String::from_utf8_lossy(text.get(8..).unwrap_or_default());
            let mut words = text.split_whitespace().map(|word| u64::from_str_radix(word, 16));
            if let (Some(Ok(delay)), Some(Ok(n_samples))) = (words.nth(1), words.nth(1))
                && n_samples > 0
            {
                edits.itunes = Some((delay, n_samples));
            }
        }
        start += size;
    }
    Ok(())
}

fn word(input: &mut impl Read) -> io::Result<u32> {
    Ok(u32::from_be_bytes(array(input)?))
}

fn array<const N: usize>(input: &mut impl Read) -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    input.read_exact(&mut bytes)?;
    Ok(bytes)
}
