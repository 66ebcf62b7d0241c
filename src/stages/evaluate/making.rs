//! How a motion was made, and what it was asked to do, as its row in `generations` says.

use anyhow::Context as _;

use crate::evaluation::keyframe::Keyframe;
use crate::motion::Placement;
use crate::motion::choreography::group::side_by_side;
use crate::motion::postprocess::PostProcessConfig;
use crate::stages::generate::{GroupSettings, MotionSettings, TokensSettings, keyframes_of};
use crate::store::tables::GenerationRow;

/// What evaluate asks of the settings of a motion.
pub struct Making {
    /// Candidates that it was chosen from.
    pub n_candidates: usize,
    /// Whether decoded motion agrees with itself by construction.
    pub decoder_derives: bool,
    /// Whether decoded motion has the phase of its music by construction.
    pub phase_given: bool,
    pub postprocess: PostProcessConfig,
}

impl Making {
    /// Reads the settings of a motion by a model of any family; none where there are none that are known.
    pub fn of_row(row: &GenerationRow) -> Option<Self> {
        let text = row.settings.as_ref()?;
        if let Ok(settings) = serde_json::from_str::<MotionSettings>(text) {
            let MotionSettings { best_of, decoder_derives, phase_given, postprocess, .. } =
                settings;
            return Some(Self { n_candidates: best_of, decoder_derives, phase_given, postprocess });
        }
        if let Some(settings) = GroupSettings::of_text(text) {
            return Some(Self {
                n_candidates: 1,
                decoder_derives: false,
                phase_given: !settings.no_clock,
                postprocess: settings.postprocess,
            });
        }
        let settings: TokensSettings = serde_json::from_str(text).ok()?;
        Some(Self {
            n_candidates: 1,
            decoder_derives: false,
            // Motion of tokens is made with the phase of the clock that its planner hears.
            phase_given: !settings.no_clock,
            postprocess: settings.postprocess,
        })
    }
}

/// Reads what each of `n_dancers` was asked to do, from the text that generate wrote down: the dancers of a group go beside each
/// other along what it says.
///
/// # Errors
/// One sentence for a text that is no such thing.
pub fn keyframes(row: &GenerationRow, n_dancers: usize) -> anyhow::Result<Vec<Vec<Keyframe>>> {
    let Some(text) = &row.constraints else { return Ok(vec![Vec::new(); n_dancers]) };
    let n_frames = usize::try_from(row.n_frames).unwrap_or(0);
    let asked =
        keyframes_of(text, n_frames).with_context(|| format!("motion {}", row.generation))?;
    if n_dancers < 2 {
        return Ok(vec![asked; n_dancers]);
    }
    let beside = |place: &Placement| {
        let by_m = [place.x_m, 0.0, place.z_m];
        let moved = |keyframe: &Keyframe| {
            let axis = |i: usize| keyframe.position_m[i].map(|x| x + by_m[i]);
            Keyframe { position_m: std::array::from_fn(axis), ..*keyframe }
        };
        asked.iter().map(moved).collect()
    };
    Ok(side_by_side(n_dancers, row.seed as u64).iter().map(beside).collect())
}
