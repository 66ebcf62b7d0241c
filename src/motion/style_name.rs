//! Styles of motion by name, such as a dance genre: what can be a name, and which values of the style channels it means.

use std::collections::BTreeMap;

use ndarray::ArrayView2;

use super::channels::Channel;
use super::style::STYLE_DIM;

/// Values of the style channels by the name of a style.
pub type NamedStyles = BTreeMap<String, [f32; STYLE_DIM]>;

/// Longest name of a style, in characters.
pub const MAX_STYLE_NAME: usize = 64;

/// Returns whether a text can name a style: a number would be read as a value of a style channel.
pub fn is_style_name(name: &str) -> bool {
    let is_part = |c: char| c.is_alphanumeric() || " -_'".contains(c);
    (1..=MAX_STYLE_NAME).contains(&name.chars().count())
        && name.chars().all(is_part)
        && name.parse::<f32>().is_err()
}

/// Returns the style that the name of a phrase tells, as AIST++ names its recordings: `gBR_sBM_cAll_d04_mBR0_ch01`.
///
/// Tsuchida et al., "AIST Dance Video Database", ISMIR 2019, table 1.
pub fn style_of_name(phrase_id: &str) -> Option<&'static str> {
    let name = phrase_id.rsplit('/').next()?;
    let (genre, rest) = name.strip_prefix('g')?.split_once('_')?;
    let name = match genre {
        "BR" => "break",
        "PO" => "pop",
        "LO" => "lock",
        "WA" => "waack",
        "MH" => "middle hip-hop",
        "LH" => "LA-style hip-hop",
        "HO" => "house",
        "KR" => "krump",
        "JS" => "street jazz",
        "JB" => "ballet jazz",
        _ => return None,
    };
    // The next part tells the situation: basic, advanced, and so on.
    rest.starts_with('s').then_some(name)
}

/// Means of the style channels over all frames of each name.
#[derive(Clone, Debug, Default)]
pub struct StyleMeans(BTreeMap<String, ([f64; STYLE_DIM], u64)>);

impl StyleMeans {
    /// Adds motion of a style, `[T, 25]`.
    pub fn add(&mut self, name: &str, motion: ArrayView2<f32>) {
        let (sums, n_frames) = self.0.entry(name.to_owned()).or_default();
        for (sum, channel) in sums.iter_mut().zip(Channel::Style.range()) {
            *sum += motion.column(channel).iter().map(|&x| f64::from(x)).sum::<f64>();
        }
        *n_frames += motion.nrows() as u64;
    }

    /// Returns the mean of each name.
    pub fn means(&self) -> NamedStyles {
        let with_frames = self.0.iter().filter(|(_, (_, n_frames))| *n_frames > 0);
        with_frames
            .map(|(name, (sums, n_frames))| {
                (name.clone(), sums.map(|sum| (sum / *n_frames as f64) as f32))
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recordings_of_aist_tell_their_genre_and_other_names_nothing() {
        assert_eq!(style_of_name("gBR_sBM_cAll_d04_mBR0_ch01"), Some("break"));
        assert_eq!(style_of_name("set/gJB_sFM_c01_d07_mJB3_ch05"), Some("ballet jazz"));
        for other in ["gXX_sBM_cAll", "gBR_BM", "gBR", "groove_s", "BR_sBM", "mBR0", ""] {
            assert_eq!(style_of_name(other), None, "{other}");
        }
    }

    #[test]
    fn names_of_styles_are_no_numbers_and_stay_on_a_line() {
        assert!(
            ["house", "LA-style hip-hop", "Wiener Walzer", "l'été"]
                .iter()
                .all(|name| is_style_name(name))
        );
        let long = "a".repeat(MAX_STYLE_NAME + 1);
        for bad in ["", "0.5", "-1", "inf", "a,b", "a\nb", long.as_str()] {
            assert!(!is_style_name(bad), "{bad:?}");
        }
    }

    #[test]
    fn means_are_over_all_frames_of_a_name() {
        let motion = |n: usize, x: f32| ndarray::Array2::from_elem((n, 25), x);
        let mut means = StyleMeans::default();
        means.add("house", motion(3, 0.5).view());
        means.add("house", motion(1, -0.5).view());
        means.add("break", motion(2, 0.125).view());
        means.add("none", motion(0, 0.0).view());
        let expected = [("break".to_owned(), [0.125; 8]), ("house".to_owned(), [0.25; 8])];
        assert_eq!(means.means(), expected.into());
    }
}
