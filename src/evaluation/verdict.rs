//! Verdicts: what may be said of a run, each resting on tests that can be lost.
//!
//! | verdict | asks |
//! |---|---|
//! | sound | does the motion obey itself, as decoded and after post-processing? |
//! | like real | does it move as held-out real motion does? |
//! | follows music | does it rise and fall with the bars of its own music? |
//! | varied | does other music get other motion? |
//! | together | of groups: do its dancers belong together, and keep apart? |
//!
//! A verdict is won only if every test of it is won, and lost if one is lost. Where something that a test needs was
//! not measured, the test is open, and with it the verdict. Rules and limits stand here and nowhere else;
//! `docs/evaluate.md` lists them.

mod follows;
mod like_real;
mod sound;
mod together;
mod varied;

use super::interval::Estimate;
use super::metrics::Number;

/// The quality that a verdict judges.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Quality {
    Sound,
    LikeReal,
    FollowsMusic,
    Varied,
    /// Of groups alone.
    Together,
}

impl Quality {
    /// Every quality that is asked of a soloist, in the order in which they are told.
    pub const OF_SOLOISTS: [Self; 4] =
        [Self::Sound, Self::LikeReal, Self::FollowsMusic, Self::Varied];

    /// Returns the name of the verdict in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Sound => "sound",
            Self::LikeReal => "like_real",
            Self::FollowsMusic => "follows_music",
            Self::Varied => "varied",
            Self::Together => "together",
        }
    }
}

/// How a test or a verdict ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    Won,
    Lost,
    /// Not enough was measured to tell.
    Open,
}

impl Outcome {
    /// Returns the name of the outcome in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Won => "won",
            Self::Lost => "lost",
            Self::Open => "open",
        }
    }

    fn of(is_won: Option<bool>) -> Self {
        match is_won {
            Some(true) => Self::Won,
            Some(false) => Self::Lost,
            None => Self::Open,
        }
    }
}

/// The bound that a value must keep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Rule {
    AtLeast(f64),
    AtMost(f64),
    Below(f64),
    Above(f64),
    Within(f64, f64),
}

impl Rule {
    fn keeps(self, x: f64) -> bool {
        match self {
            Self::AtLeast(limit) => x >= limit,
            Self::AtMost(limit) => x <= limit,
            Self::Below(limit) => x < limit,
            Self::Above(limit) => x > limit,
            Self::Within(low, high) => x >= low && x <= high,
        }
    }

    /// Returns the rule in words, without its numbers where a range has two.
    pub fn words(self) -> String {
        match self {
            Self::AtLeast(_) => "at least".to_owned(),
            Self::AtMost(_) => "at most".to_owned(),
            Self::Below(_) => "below".to_owned(),
            Self::Above(_) => "above".to_owned(),
            Self::Within(low, high) => format!("{low} to {high}"),
        }
    }

    /// Returns the limit: of a range the upper one.
    pub const fn limit(self) -> f64 {
        match self {
            Self::AtLeast(x) | Self::AtMost(x) | Self::Below(x) | Self::Above(x) => x,
            Self::Within(_, high) => high,
        }
    }
}

/// A test that a verdict rests on.
#[derive(Clone, Debug, PartialEq)]
pub struct Test {
    pub name: &'static str,
    pub outcome: Outcome,
    /// The measured statistic, in words.
    pub statistic: String,
    pub estimate: Estimate,
    pub unit: &'static str,
    pub rule: Rule,
    /// The value of comparison, in words.
    pub against: String,
    /// Probability by chance, and the same adjusted for the family of the verdict's tests (Holm).
    pub p: Option<f64>,
    pub p_holm: Option<f64>,
}

impl Test {
    /// A test of whether a value keeps a rule; open where there is no value.
    fn of_value(
        name: &'static str,
        statistic: impl Into<String>,
        estimate: Estimate,
        unit: &'static str,
        rule: Rule,
        against: impl Into<String>,
    ) -> Self {
        Self {
            name,
            outcome: Outcome::of(estimate.value.map(|x| rule.keeps(x))),
            statistic: statistic.into(),
            estimate,
            unit,
            rule,
            against: against.into(),
            p: None,
            p_holm: None,
        }
    }

    /// Returns what the test found, in a sentence.
    pub fn message(&self) -> String {
        let Self { estimate, rule, against, unit, .. } = self;
        let mut letters = self.statistic.chars();
        let first = letters.next().map(char::to_uppercase);
        let statistic: String = first.into_iter().flatten().chain(letters).collect();
        let Some(value) = estimate.value else {
            return format!("{statistic} was not measured ({against})");
        };
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        let asked = match rule {
            Rule::Within(..) => rule.words(),
            _ => format!("{} {}", rule.words(), rounded(rule.limit())),
        };
        let p = self.p_holm.map(|p| format!(", p {} (Holm)", rounded(p))).unwrap_or_default();
        format!("{statistic} is {}{unit}, asked is {asked}{unit}; {against}{p}", rounded(value))
    }
}

/// Writes a number with three significant figures.
fn rounded(x: f64) -> String {
    if x == 0.0 || !x.is_finite() {
        return format!("{x}");
    }
    let decimals = (2 - x.abs().log10().floor() as i32).clamp(0, 6) as usize;
    let text = format!("{x:.decimals$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

/// A verdict with its tests.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    pub quality: Quality,
    pub outcome: Outcome,
    pub tests: Vec<Test>,
}

impl Verdict {
    fn new(quality: Quality, tests: Vec<Test>) -> Self {
        let has = |outcome| tests.iter().any(|test| test.outcome == outcome);
        let outcome = if has(Outcome::Lost) {
            Outcome::Lost
        } else if has(Outcome::Open) || tests.is_empty() {
            Outcome::Open
        } else {
            Outcome::Won
        };
        Self { quality, outcome, tests }
    }
}

/// The numbers that verdicts rest on, all of one split.
#[derive(Clone, Copy, Debug)]
pub struct Evidence<'a> {
    /// What was generated; soundness as decoded has the variant `raw`.
    pub own: &'a [Number],
    /// The same motions with the music of other songs.
    pub shuffled: &'a [Number],
    /// The same motions with the bars shifted by beats.
    pub shifted: &'a [Number],
    /// Motion of the same network with its first weights.
    pub untrained: &'a [Number],
    /// Held-out real motion.
    pub truth: &'a [Number],
    /// Whether there should be decoded motion: not where motion was made by another program.
    pub has_raw: bool,
    /// Whether there should be an untrained network.
    pub has_network: bool,
    /// What is known of groups beside their dancers' own motion; none of soloists.
    pub group: Option<GroupEvidence<'a>>,
}

/// The numbers of windows of groups, all of one split.
#[derive(Clone, Copy, Debug)]
pub struct GroupEvidence<'a> {
    pub own: &'a [Number],
    /// Soloists of the same model, each sampled by itself, in the places of the dancers.
    pub independent: &'a [Number],
    /// Held-out real groups.
    pub truth: &'a [Number],
}

/// Returns all verdicts, in the order of [`Quality::OF_SOLOISTS`], and of groups [`Quality::Together`] behind them.
pub fn verdicts(evidence: &Evidence) -> Vec<Verdict> {
    let mut verdicts = vec![
        Verdict::new(Quality::Sound, sound::tests(evidence)),
        Verdict::new(Quality::LikeReal, like_real::tests(evidence)),
        Verdict::new(Quality::FollowsMusic, follows::tests(evidence)),
        Verdict::new(Quality::Varied, varied::tests(evidence)),
    ];
    let group = evidence.group.as_ref();
    verdicts.extend(group.map(|group| Verdict::new(Quality::Together, together::tests(group))));
    verdicts
}

/// Returns the number of a metric and variant.
fn find<'a>(numbers: &'a [Number], metric: &str, variant: &str) -> Option<&'a Number> {
    numbers.iter().find(|number| number.metric == metric && number.variant == variant)
}

/// Returns a number of each song less another of the same song; none of songs that lack either.
fn differences_by_song(own: Option<&Number>, other: Option<&Number>) -> Vec<f64> {
    let (Some(own), Some(other)) = (own, other) else { return Vec::new() };
    let difference = |(song, x): (&usize, &f64)| Some(x - other.by_song.get(song)?);
    own.by_song.iter().filter_map(difference).collect()
}

/// Returns its estimate, absent where it was not measured.
fn estimate(numbers: &[Number], metric: &str, variant: &str) -> Estimate {
    find(numbers, metric, variant).map(|number| number.estimate).unwrap_or_default()
}

/// Says what a number is in held-out real motion.
fn real(truth: &[Number], metric: &str, variant: &str) -> String {
    match estimate(truth, metric, variant).value {
        Some(x) => format!("held-out real motion {}", rounded(x)),
        None => "held-out real motion was not measured".to_owned(),
    }
}

#[cfg(test)]
mod tests;
