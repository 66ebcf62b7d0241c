//! How far motions follow their music.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;

use super::super::beats::{
    BeatAlignment, BeatScore, N_SHIFTS, WIDTHS_S, beat_alignment, phase_coherence, phase_error,
    rayleigh,
};
use super::super::interval::{Estimate, clustered_mean_estimate};
use super::super::locking::{BarLocking, Passage, r2_at, wrong_tempi};
use super::{Danced, Music, Number, SEED, mean_over};

/// Wrong tempi that locking is held against: p can be as small as 1 / 200.
const N_WRONG_TEMPI: usize = 199;
/// A passage must be longer than the nine numbers that are fitted to it.
const MIN_LOCKING_FRAMES: usize = 10;

/// Measures how far motions follow the bars and beats of their music; those without music do not count.
///
/// The result is the same for any number of threads.
pub fn of_music(danced: &[Danced], n_threads: NonZeroUsize) -> Vec<Number> {
    let mut numbers = locking(danced, n_threads);
    numbers.extend(beats(danced));
    numbers.extend(phases(danced));
    numbers
}

/// Bar-phase R² of the vertical velocity: with one fit for each song, which asks that all motions for it
/// follow it alike, and with one for each motion.
fn locking(danced: &[Danced], n_threads: NonZeroUsize) -> Vec<Number> {
    let items: Vec<(&Danced, Passage)> = danced
        .iter()
        .filter_map(|item| {
            let passage = Passage { signal: &item.motion.rise_m_s, bars: &item.music?.bars };
            let n = passage.signal.len().min(passage.bars.len());
            (n >= MIN_LOCKING_FRAMES).then_some((item, passage))
        })
        .collect();
    let mut number_of: BTreeMap<usize, usize> = BTreeMap::new();
    let by_song: Vec<usize> = items
        .iter()
        .map(|(item, _)| {
            let n = number_of.len();
            *number_of.entry(item.song).or_insert(n)
        })
        .collect();
    let alone: Vec<usize> = (0..items.len()).collect();
    let passages: Vec<Passage> = items.iter().map(|item| item.1).collect();
    let ratios: Vec<f64> = std::iter::once(1.0).chain(wrong_tempi(N_WRONG_TEMPI)).collect();
    let share = ratios.len().div_ceil(n_threads.get());
    let at: Vec<Vec<Vec<f64>>> = std::thread::scope(|scope| {
        let workers: Vec<_> = ratios
            .chunks(share)
            .map(|ratios| {
                let (passages, by_song, alone) = (&passages, &by_song, &alone);
                scope.spawn(move || -> Vec<_> {
                    ratios.iter().map(|&ratio| r2_at(passages, &[by_song, alone], ratio)).collect()
                })
            })
            .collect();
        workers.into_iter().flat_map(|worker| worker.join().expect("no panic")).collect()
    });
    let of_grouping = |which: usize, variant: &str, clusters: &[usize]| {
        let r2: &[f64] = at.first().map_or(&[], |of| &of[which]);
        let wrong: Vec<Vec<f64>> = at.iter().skip(1).map(|of| of[which].clone()).collect();
        let found = BarLocking::against(r2, &wrong);
        let n = r2.len();
        let plain =
            |of: fn(&BarLocking) -> Option<f64>| Estimate::plain(found.as_ref().and_then(of), n);
        let r2 = match found {
            Some(_) => clustered_mean_estimate(r2, clusters),
            None => Estimate::plain(None, n),
        };
        let protocol = format!(
            "vertical velocity from positions, 4 harmonics of the bar, {N_WRONG_TEMPI} wrong tempi"
        );
        let number = |metric, estimate| Number::new(metric, variant, "", estimate, &*protocol);
        [
            number("locking_r2", r2),
            number("locking_wrong_r2", plain(|found| Some(found.wrong_mean))),
            number("locking_effect", plain(|found| found.effect)),
            number("locking_p", plain(|found| Some(found.p))),
        ]
    };
    let fits: Vec<usize> = (0..number_of.len()).collect();
    let [per_song, per_phrase] =
        [of_grouping(0, "per_song", &fits), of_grouping(1, "per_phrase", &by_song)];
    per_song.into_iter().chain(per_phrase).collect()
}

/// Beat scores of both directions and three widths, with what chance reaches.
fn beats(danced: &[Danced]) -> Vec<Number> {
    let scored: Vec<Option<BeatAlignment>> = danced
        .iter()
        .zip(SEED..)
        .map(|(item, seed)| {
            let music = item.music?;
            beat_alignment(&item.motion.beats, &music.beats_s, item.motion.n_frames, seed)
        })
        .collect();
    let mean = |of: &dyn Fn(&BeatAlignment) -> Option<f64>| {
        let (values, songs): (Vec<f64>, Vec<usize>) = scored
            .iter()
            .zip(danced)
            .filter_map(|(scored, item)| Some((of(scored.as_ref()?)?, item.song)))
            .unzip();
        clustered_mean_estimate(&values, &songs)
    };
    type Of = fn(&BeatScore) -> Option<f64>;
    let kinds: [(&'static str, Of); 4] = [
        ("beat_alignment", |score| Some(score.score)),
        ("beat_alignment_chance", |score| Some(score.chance)),
        ("beat_alignment_lift", |score| score.lift),
        ("beat_alignment_z", |score| score.z),
    ];
    let protocol = format!("minima of speed over 5 frames, chance by {N_SHIFTS} circular shifts");
    let mut numbers = Vec::new();
    for (metric, of) in kinds {
        for (width, width_s) in WIDTHS_S.into_iter().enumerate() {
            let to_music = mean(&|found| of(&found.motion_to_music[width]));
            let to_motion = mean(&|found| of(&found.music_to_motion[width]));
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

/// The phase that motions say, and the music's phase at the beats of motion.
fn phases(danced: &[Danced]) -> [Number; 4] {
    type Of<'a> = &'a dyn Fn(&Danced, &Music, &[f64]) -> Option<f64>;
    let with = |of: Of| {
        mean_over(danced, |item| {
            let music = item.music?;
            let phase: Vec<f64> = music.bars.iter().map(|x| x.rem_euclid(1.0)).collect();
            of(item, music, &phase)
        })
    };
    let protocol = "phase of the music's bars, from its beats";
    [
        Number::new(
            "phase_error",
            "",
            "bars",
            with(&|item, _, phase| phase_error(&item.motion.phase, phase)),
            protocol,
        ),
        Number::new(
            "phase_coherence",
            "bars",
            "",
            with(&|item, _, phase| phase_coherence(&item.motion.phase, phase, 1)),
            protocol,
        ),
        Number::new(
            "phase_coherence",
            "beats",
            "",
            with(&|item, music, phase| {
                phase_coherence(&item.motion.phase, phase, music.beats_per_bar)
            }),
            protocol,
        ),
        Number::new(
            "rayleigh",
            "",
            "",
            with(&|item, music, phase| rayleigh(phase, &item.motion.beats, music.beats_per_bar)),
            protocol,
        ),
    ]
}
