//! A constructed phrase as rows of `phrases` and `beats`.

use super::one::{ConstructedPhrase, SongMusic};
use super::songs::Song;
use crate::stages::beats;
use crate::store::digest;
use crate::store::tables::{BeatRow, CONSTRUCTED, PhraseRow};
use crate::units::frames_to_s;

/// Returns the row of a phrase; it has no files of its own.
pub fn phrase_row(song: &Song, music: &SongMusic, phrase: &ConstructedPhrase) -> PhraseRow {
    let n_frames = phrase.n_frames();
    PhraseRow {
        phrase_id: phrase.id.clone(),
        source: song.url.clone(),
        motion_url: None,
        features_url: None,
        audio_url: None,
        beats_url: None,
        motion_bytes: None,
        features_bytes: None,
        audio_bytes: None,
        beats_bytes: None,
        content_hash: content_hash(phrase),
        song_hash: music.song_hash.clone(),
        has_motion: true,
        has_features: true,
        has_audio: false,
        has_beats: !phrase.beats.is_empty(),
        motion_format: Some(CONSTRUCTED.to_owned()),
        motion_root: None,
        motion_up: None,
        motion_unit_m: None,
        motion_cut_s: None,
        motion_notes: None,
        audio_codec: None,
        sample_rate_hz: None,
        n_channels: None,
        duration_s: frames_to_s(n_frames),
        start_s: Some(frames_to_s(phrase.first_frame)),
        n_frames: Some(n_frames as i64),
        n_feature_frames: Some(n_frames as i64),
        split: song.split.to_owned(),
        tempo_bpm: Some(music.beats.tempo_bpm()),
        tempo_source: Some(music.tempo_source().to_owned()),
        beats_per_bar: Some(music.beats.beats_per_bar() as i32),
        beats_per_bar_source: Some(music.beats_per_bar_source().to_owned()),
        n_dancers: Some(phrase.n_dancers() as i32),
        formation: phrase.formation.map(|formation| formation.name().to_owned()),
        unison: phrase.unison.map(|unison| unison.name().to_owned()),
        style_name: None,
    }
}

/// Digest over one line `role digest` for features and motion, as for the files of a phrase.
fn content_hash(phrase: &ConstructedPhrase) -> String {
    let digest_of_values = |values: &mut dyn Iterator<Item = &f32>| {
        let bytes: Vec<u8> = values.flat_map(|x| x.to_le_bytes()).collect();
        digest(&bytes)
    };
    let lines = format!(
        "features {}\nmotion {}\n",
        digest_of_values(&mut phrase.features.iter()),
        digest_of_values(&mut phrase.motion.iter())
    );
    digest(lines.as_bytes())
}

/// Returns the rows of a phrase's beats.
pub fn beat_rows<'a>(
    music: &SongMusic,
    phrase: &'a ConstructedPhrase,
) -> impl Iterator<Item = BeatRow> + 'a {
    let numbered = phrase.beats.iter().map(|&(time_s, number)| (time_s, Some(i64::from(number))));
    beats::rows(&phrase.id, numbered, phrase.n_frames(), music.beat_source)
}
