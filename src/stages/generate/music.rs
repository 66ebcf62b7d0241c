//! The music of a phrase, and what a network hears of it.

use ndarray::{Array2, ArrayView2};

use crate::model::{ConditionConfig, condition};
use crate::motion::{Beats, bar_phase, clock};
use crate::units::frames_to_s;

/// The music of a phrase or file, to which motion is generated.
pub struct PhraseMusic<'a> {
    pub phrase_id: &'a str,
    /// Digest of what the phrase's files hold, as `generations` has it.
    pub content_hash: &'a str,
    /// The name in messages and failures.
    pub source: &'a str,
    /// \[T, 163\]
    pub features: ArrayView2<'a, f32>,
    pub beats: Option<Beats>,
    /// Whether the downbeats are known: counted by somebody, or taken to begin with the first beat of a song.
    pub has_downbeats: bool,
}

/// What a network hears of the music of a phrase, and where its bars are.
pub struct HeardMusic {
    /// Phase of the bar in every frame, where beats are known.
    pub phase: Option<Vec<f64>>,
    /// \[T, condition_dim\]
    pub condition: Array2<f32>,
    has_downbeats: bool,
    has_clock: bool,
}

impl PhraseMusic<'_> {
    /// Returns what a network hears; `no_clock` withholds the clock from one that hears it.
    pub fn heard_by(&self, network: impl Into<ConditionConfig>, no_clock: bool) -> HeardMusic {
        let network = network.into();
        let phase = self.beats.as_ref().map(|beats| {
            let times_s: Vec<f64> = (0..self.features.nrows()).map(frames_to_s).collect();
            bar_phase(&times_s, beats)
        });
        let bars = phase.as_deref().filter(|_| self.has_downbeats && !no_clock);
        let known = bars.zip(self.beats.as_ref());
        let clock = known.map(|(bars, beats)| clock(bars, beats.beats_per_bar()));
        let clock = clock.as_ref().map(|clock| clock.view());
        let has_clock = network.clock && clock.is_some();
        let condition = condition(network, self.features, clock);
        HeardMusic { phase, condition, has_downbeats: self.has_downbeats, has_clock }
    }
}

impl HeardMusic {
    /// Returns the phase of the bar, where downbeats are known, too.
    pub fn bars(&self) -> Option<&[f64]> {
        self.phase.as_deref().filter(|_| self.has_downbeats)
    }

    /// Returns the phase that motion is sampled with: that of the clock which the network hears.
    pub fn clock_phase(&self) -> Option<&[f64]> {
        self.bars().filter(|_| self.has_clock)
    }
}
