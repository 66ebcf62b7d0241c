//! The inputs that tell a network of the music: the same in every file that hears it.

use crate::audio::FeatureScale;
use crate::model::{ConditionConfig, Graph as _, Result};
use crate::motion::CLOCK_DIM;

use super::builder::{Axes, Builder, Value};

/// Names of the inputs.
#[derive(Clone, Copy, Debug)]
pub struct MusicNames;

impl MusicNames {
    pub const AUDIO: &'static str = "audio";
    /// Only in networks that hear the clock.
    pub const CLOCK: &'static str = "clock";
    /// May be left out.
    pub const DROP_AUDIO: &'static str = "drop_audio";
    /// May be left out; only in networks that take a style.
    pub const STYLE: &'static str = "style";
}

/// The conditions of a network: music and style.
pub(super) struct ConditionValues {
    /// Features in units of their spread, then the clock.
    pub audio: Value,
    pub drop_audio: Value,
    pub style: Option<Value>,
}

impl ConditionValues {
    /// Adds the inputs; features come as the `features` table has them and are scaled within.
    ///
    /// `who` goes without music: samples, groups or windows.
    pub fn inputs(
        g: &mut Builder<'_>,
        heard: ConditionConfig,
        style_dim: usize,
        who: &str,
        scale: &FeatureScale,
    ) -> Result<Self> {
        let audio = g.input(
            MusicNames::AUDIO,
            Axes::Frames,
            heard.audio_cond_dim,
            "features of the music as motiongen extract writes them",
        );
        let clock = heard.clock.then(|| {
            g.input(
                MusicNames::CLOCK,
                Axes::Frames,
                CLOCK_DIM,
                "cos and sin of 2 pi n bars for n = 1, 2, 3 and the beats of a bar, ln(tempo / 120), 1 where known; \
                 zeros where unknown",
            )
        });
        let meaning = format!("1 for {who} that go without music, 0 where left out");
        let drop_audio = g.optional_input(MusicNames::DROP_AUDIO, Axes::Batch, 0, &meaning);
        let style = (style_dim > 0).then(|| {
            let meaning = "style, normalised, 0 for none";
            g.optional_input(MusicNames::STYLE, Axes::Samples, style_dim, meaning)
        });
        let features = g.standardized(audio, &scale.centre, &scale.scale)?;
        let audio = match &clock {
            Some(clock) => g.concat(&[&features, clock])?,
            None => features,
        };
        Ok(Self { audio, drop_audio, style })
    }
}
