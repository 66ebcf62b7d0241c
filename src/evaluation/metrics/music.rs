//! How far windows follow their music.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;

use super::{MotionWindow, MusicWindow, Number, SEED, mean_over, staged};
use crate::evaluation::beats::{
    BeatAlignment, BeatScore, N_SHIFTS, WIDTHS_S, beat_alignment, phase_coherence, phase_error,
    rayleigh,
};
use crate::evaluation::coupling::{
    CoupledPassage, Coupling, CouplingSums, Harmonics, N_ROTATIONS, consistency_p, rotation_p,
};
use crate::evaluation::interval::{Estimate, clustered_mean_estimate, mean_estimate};
use crate::evaluation::locking::{BarLocking, Passage, r2_at, wrong_tempi};

/// Wrong tempi that locking is held against.
pub const N_WRONG_TEMPI: usize = 199;

/// Reference values that windows are compared with.
#[derive(Clone, Copy, Debug)]
pub struct MusicContext<'a> {
    /// The known dependence of vertical velocity on the phase in the bar; none where it is not known.
    pub coupling: Option<&'a Coupling>,
    /// Wrong tempi that are tried; none of them where there is no need.
    pub n_wrong_tempi: usize,
    pub n_threads: NonZeroUsize,
}

/// Measures how far windows follow the bars and beats of their music; those without music do not count.
///
/// The result is the same for any number of threads.
pub fn music_numbers(danced: &[MotionWindow], context: &MusicContext) -> Vec<Number> {
    let mut numbers = locking_numbers(danced, context);
    numbers.extend(coupling_numbers(danced, context.coupling));
    numbers.extend(beat_numbers(danced));
    numbers
}

/// Windows with music, by number of the song.
fn passages<'a>(danced: &'a [MotionWindow]) -> impl Iterator<Item = (usize, CoupledPassage<'a>)> {
    danced.iter().filter_map(|item| {
        let music = item.music.as_ref()?;
        let passage = CoupledPassage {
            rise_m_s: &item.motion.rise_m_s,
            bars: music.bars,
            beats_per_bar: music.beats_per_bar,
            activity: music.activity,
        };
        (!passage.rise_m_s.is_empty()).then_some((item.song, passage))
    })
}

/// Returns the harmonics of the bar of each song's vertical velocity.
pub fn song_harmonics(danced: &[MotionWindow]) -> BTreeMap<usize, Harmonics> {
    let mut songs: BTreeMap<usize, Harmonics> = BTreeMap::new();
    for (song, passage) in passages(danced) {
        songs.entry(song).or_default().add(&passage);
    }
    songs
}

fn song_couplings(danced: &[MotionWindow], coupling: &Coupling) -> BTreeMap<usize, CouplingSums> {
    let mut songs: BTreeMap<usize, CouplingSums> = BTreeMap::new();
    for (song, passage) in passages(danced) {
        songs.entry(song).or_default().add(coupling, &passage);
    }
    songs
}

/// The coefficient on the known coupling, and the probability of as high a one by chance.
fn coupling_numbers(danced: &[MotionWindow], coupling: Option<&Coupling>) -> Vec<Number> {
    let Some(coupling) = coupling else {
        let songs: Vec<Harmonics> = song_harmonics(danced).into_values().collect();
        let protocol = format!(
            "no coupling is known: the same at one place of the bar in every song, bars of each song \
             rotated, {N_ROTATIONS} times"
        );
        let p = Estimate::plain(consistency_p(&songs, SEED), songs.len());
        return vec![Number::new("locking_p", "per_song", "", p, protocol)];
    };
    let songs = song_couplings(danced, coupling);
    let by_song: BTreeMap<usize, f64> =
        songs.iter().filter_map(|(song, sums)| Some((*song, sums.coefficient(0.0)?))).collect();
    let values: Vec<f64> = by_song.values().copied().collect();
    let sums: Vec<CouplingSums> = songs.into_values().collect();
    let protocol = format!(
        "vertical velocity of positions on the {} coupling, mean over songs",
        coupling.name()
    );
    let rotated = format!(
        "coefficient on the {} coupling, bars of each song rotated, {N_ROTATIONS} times",
        coupling.name()
    );
    let p = Estimate::plain(rotation_p(&sums, SEED), sums.len());
    vec![
        Number::new("coupling", coupling.name(), "", mean_estimate(&values), protocol)
            .with_songs(by_song),
        Number::new("locking_p", "per_song", "", p, rotated),
    ]
}

/// Measures the coefficient on the known coupling with the bar shifted by whole beats: of each song the highest.
pub fn shifted_numbers(danced: &[MotionWindow], coupling: &Coupling) -> Vec<Number> {
    let beats: BTreeMap<usize, u32> = danced
        .iter()
        .filter_map(|item| Some((item.song, item.music.as_ref()?.beats_per_bar)))
        .collect();
    let highest = |(song, sums): (usize, CouplingSums)| -> Option<(usize, f64)> {
        let n = *beats.get(&song)?;
        let shifts = (1..n).map(|k| f64::from(k) / f64::from(n));
        let found = shifts.filter_map(|shift| sums.coefficient(shift)).reduce(f64::max)?;
        Some((song, found))
    };
    let by_song: BTreeMap<usize, f64> =
        song_couplings(danced, coupling).into_iter().filter_map(highest).collect();
    let values: Vec<f64> = by_song.values().copied().collect();
    let protocol = "bars shifted by a whole number of beats, of each song the highest";
    vec![
        Number::new("coupling", coupling.name(), "", mean_estimate(&values), protocol)
            .with_songs(by_song),
    ]
}

/// Bar-phase R² of the vertical velocity with one fit for each song, which asks that all motions for it follow
/// it alike.
fn locking_numbers(danced: &[MotionWindow], context: &MusicContext) -> Vec<Number> {
    let mut number_of: BTreeMap<usize, usize> = BTreeMap::new();
    let (mut groups, mut windows) = (Vec::new(), Vec::new());
    for (song, passage) in passages(danced) {
        let n = number_of.len();
        groups.push(*number_of.entry(song).or_insert(n));
        windows.push(Passage { signal: passage.rise_m_s, bars: passage.bars });
    }
    let ratios: Vec<f64> = std::iter::once(1.0).chain(wrong_tempi(context.n_wrong_tempi)).collect();
    let share = ratios.len().div_ceil(context.n_threads.get());
    let at: Vec<Vec<f64>> = std::thread::scope(|scope| {
        let workers: Vec<_> = ratios
            .chunks(share)
            .map(|ratios| {
                let (windows, groups) = (&windows, &groups);
                scope.spawn(move || -> Vec<_> {
                    ratios.iter().map(|&ratio| r2_at(windows, groups, ratio)).collect()
                })
            })
            .collect();
        workers.into_iter().flat_map(|worker| worker.join().expect("no panic")).collect()
    });
    let r2: &[f64] = at.first().map_or(&[], |found| found);
    let mut songs: Vec<(usize, usize)> = number_of.into_iter().map(|(song, i)| (i, song)).collect();
    songs.sort_unstable();
    // Songs without a fit are left out of R², so that places agree only where all have one.
    let by_song: BTreeMap<usize, f64> = match songs.len() == r2.len() {
        true => songs.iter().zip(r2).map(|((_, song), r2)| (*song, *r2)).collect(),
        false => BTreeMap::new(),
    };
    let estimate = mean_estimate(r2).within(0.0, 1.0);
    let tempi = context.n_wrong_tempi;
    let protocol =
        "vertical velocity of positions, 4 free harmonics of the bar, one fit for a song";
    let mut numbers =
        vec![Number::new("locking_r2", "per_song", "", estimate, protocol).with_songs(by_song)];
    if tempi > 0 {
        let found = BarLocking::against(r2, &at[1..]);
        let protocol = format!("{protocol}, {tempi} wrong tempi");
        let plain = |value: fn(&BarLocking) -> Option<f64>| {
            Estimate::plain(found.as_ref().and_then(value), r2.len())
        };
        let number = |metric, estimate| Number::new(metric, "per_song", "", estimate, &*protocol);
        numbers.extend([
            number("locking_wrong_r2", plain(|found| Some(found.wrong_mean))),
            number("locking_effect", plain(|found| found.effect)),
            number("locking_wrong_share", plain(|found| Some(found.wrong_share))),
        ]);
    }
    numbers
}

/// Beat scores of both directions and three widths, with what chance reaches.
fn beat_numbers(danced: &[MotionWindow]) -> Vec<Number> {
    let scored: Vec<(usize, BeatAlignment)> = danced
        .iter()
        .zip(SEED..)
        .filter_map(|(item, seed)| {
            let music = item.music.as_ref()?;
            let beats = &item.motion.beats;
            let found = beat_alignment(beats, &music.beats_s, item.motion.n_frames, seed)?;
            Some((item.song, found))
        })
        .collect();
    let mean = |value: &dyn Fn(&BeatAlignment) -> Option<f64>| {
        let (values, songs): (Vec<f64>, Vec<usize>) =
            scored.iter().filter_map(|(song, found)| Some((value(found)?, *song))).unzip();
        clustered_mean_estimate(&values, &songs)
    };
    type ScoreValue = fn(&BeatScore) -> Option<f64>;
    let kinds: [(&'static str, ScoreValue); 4] = [
        ("beat_alignment", |score| Some(score.score)),
        ("beat_alignment_chance", |score| Some(score.chance)),
        ("beat_alignment_lift", |score| score.lift),
        ("beat_alignment_z", |score| score.z),
    ];
    let protocol = format!("minima of speed over 5 frames, chance by {N_SHIFTS} circular shifts");
    let mut numbers = Vec::new();
    for (metric, value) in kinds {
        for (width, width_s) in WIDTHS_S.into_iter().enumerate() {
            let to_music = mean(&|found| value(&found.motion_to_music[width]));
            let to_motion = mean(&|found| value(&found.music_to_motion[width]));
            for (direction, estimate) in
                [("motion_to_music", to_music), ("music_to_motion", to_motion)]
            {
                let variant = format!("{direction} {width_s} s");
                numbers.push(Number::new(metric, variant, "", estimate, &*protocol));
            }
        }
    }
    numbers
}

/// Where the phase of a motion comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PhaseOrigin {
    /// It was decoded, or made with the motion.
    Own,
    /// Post-processing set it to the music's.
    Relocked,
    /// There is none.
    Absent,
}

/// Measures the phase that motions say against the music's, and the music's phase at the beats of motion.
///
/// Where the phase is not the motion's own, or the music's bars were read from the motion, there is nothing to hold
/// it against, and its numbers are absent. `stage` is added to the variants, where it is not empty.
pub fn phase_numbers(danced: &[MotionWindow], origin: PhaseOrigin, stage: &str) -> Vec<Number> {
    type WindowValue<'a> = &'a dyn Fn(&MotionWindow, &MusicWindow, &[f64]) -> Option<f64>;
    let mean = |needs_own_phase: bool, value: WindowValue| {
        mean_over(danced, |item| {
            let music = item.music.as_ref()?;
            if needs_own_phase && (origin != PhaseOrigin::Own || music.is_of_motion) {
                return None;
            }
            let phase: Vec<f64> = music.bars.iter().map(|x| x.rem_euclid(1.0)).collect();
            value(item, music, &phase)
        })
    };
    let protocol = match origin {
        PhaseOrigin::Own => "phase of the music's bars, from its beats",
        PhaseOrigin::Relocked => "by construction: post-processing sets the phase to the music's",
        PhaseOrigin::Absent => "the motion says no phase",
    };
    let number =
        |metric: &'static str, variant: &str, unit, needs_own_phase, value: WindowValue| {
            let (estimate, by_song) = mean(needs_own_phase, value);
            Number::new(metric, staged(variant, stage), unit, estimate.non_negative(), protocol)
                .with_songs(by_song)
        };
    vec![
        number("phase_error", "", "bars", true, &|item, _, phase| {
            phase_error(&item.motion.phase, phase)
        }),
        number("phase_coherence", "bars", "", true, &|item, _, phase| {
            phase_coherence(&item.motion.phase, phase, 1)
        }),
        number("phase_coherence", "beats", "", true, &|item, music, phase| {
            phase_coherence(&item.motion.phase, phase, music.beats_per_bar)
        }),
        number("rayleigh", "", "", false, &|item, music, phase| {
            rayleigh(phase, &item.motion.beats, music.beats_per_bar)
        }),
    ]
}
