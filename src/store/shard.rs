//! Which items a process takes, and which batch an item belongs to.
//!
//! Both come from one stable 64-bit hash of the item's name, cut into equal ranges. Shards and
//! batches therefore nest whenever the number of shards is a power of two, and any number of
//! shards gives the same rows.

use std::fmt;
use std::num::NonZeroU32;

use xxhash_rust::xxh3::xxh3_64_with_seed;

use super::StoreError;

/// Seeds keep the uses of the hash independent of each other.
const SHARD_SEED: u64 = 0;
const SPLIT_SEED: u64 = 1;

/// Environment variables (index, count) that array jobs set.
const ARRAY_VARIABLES: [(&str, &str); 3] = [
    (SLURM_INDEX, "SLURM_ARRAY_TASK_COUNT"),
    ("JOB_COMPLETION_INDEX", "JOB_COMPLETION_COUNT"),
    ("BATCH_TASK_INDEX", "BATCH_TASK_COUNT"),
];
/// A Slurm array may start at any index and go in steps of any size, or be a list.
const SLURM_INDEX: &str = "SLURM_ARRAY_TASK_ID";
const SLURM_MIN: &str = "SLURM_ARRAY_TASK_MIN";
const SLURM_MAX: &str = "SLURM_ARRAY_TASK_MAX";
const SLURM_STEP: &str = "SLURM_ARRAY_TASK_STEP";

/// Part `index` of `count` of a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shard {
    index: u32,
    count: u32,
}

impl Shard {
    /// The whole job in one process.
    pub const WHOLE: Shard = Shard { index: 0, count: 1 };

    /// Parses `i/n`, or `auto` from the variables of Slurm arrays, Kubernetes indexed jobs and
    /// Google Cloud Batch tasks; `environment` looks a variable up.
    ///
    /// # Errors
    /// [`StoreError::BadShard`].
    pub fn parse(
        text: &str,
        environment: impl Fn(&str) -> Option<String>,
    ) -> Result<Self, StoreError> {
        let bad = |reason: String| StoreError::BadShard { text: text.to_owned(), reason };
        let number = |what: &str, digits: &str| {
            digits
                .trim()
                .parse::<u32>()
                .map_err(|_| bad(format!("has no number in {what} ({digits:?})")))
        };
        if text == "auto" {
            for (index, count) in ARRAY_VARIABLES {
                let Some(i) = environment(index) else { continue };
                let Some(n) = environment(count) else {
                    return Err(bad(format!("finds {index} set but not {count}; set both")));
                };
                let (mut i, n) = (number(index, &i)?, number(count, &n)?);
                if index == SLURM_INDEX {
                    let variable =
                        |name: &str| environment(name).map(|text| number(name, &text)).transpose();
                    let (first, last, step) =
                        (variable(SLURM_MIN)?, variable(SLURM_MAX)?, variable(SLURM_STEP)?);
                    i = place_in_array(i, n, first.unwrap_or(0), last, step.unwrap_or(1))
                        .map_err(bad)?;
                }
                return Self::new(i, n).map_err(bad);
            }
            let names: Vec<_> = ARRAY_VARIABLES.iter().map(|v| v.0).collect();
            return Err(bad(format!("finds none of {} set", names.join(", "))));
        }
        let (i, n) = text.split_once('/').ok_or_else(|| bad("has no \"/\"".into()))?;
        Self::new(number("the index", i)?, number("the count", n)?).map_err(bad)
    }

    fn new(index: u32, count: u32) -> Result<Self, String> {
        if count == 0 {
            return Err("has a count of 0".into());
        }
        if index >= count {
            return Err(format!("has index {index} but only {count} shards"));
        }
        Ok(Self { index, count })
    }

    /// Returns whether this shard takes `item`.
    pub fn takes(self, item: &str) -> bool {
        range_of(stable_hash(item), u64::from(self.count)) == u64::from(self.index)
    }
}

/// Returns which of `count` shards takes `item`.
pub fn shard_of(item: &str, count: NonZeroU32) -> u32 {
    let shard = range_of(stable_hash(item), u64::from(count.get()));
    u32::try_from(shard).expect("invariant: a range is below their count")
}

/// Returns the place of a Slurm task among the `count` of its array.
///
/// A list of tasks does not say how many there were when the job was cut into shards; if each task did only its
/// own shard, phrases would be left out.
fn place_in_array(
    id: u32,
    count: u32,
    first: u32,
    last: Option<u32>,
    step: u32,
) -> Result<u32, String> {
    let way_out = format!(
        "submit the whole array again, since what is done is skipped, or give the shard of the former array: \
         --shard ${SLURM_INDEX}/N for --array=0-(N-1)"
    );
    let Some(from_first) = id.checked_sub(first) else {
        return Err(format!("finds {SLURM_INDEX} {id} below {SLURM_MIN} {first}"));
    };
    if step == 0 {
        return Err(format!("finds {SLURM_STEP} 0"));
    }
    if let Some(last) = last
        && last.saturating_sub(first) / step + 1 != count
    {
        return Err(format!(
            "finds a Slurm array of {count} tasks from {first} to {last} in steps of {step}, so it is a list of tasks, \
             which does not tell the shards of the whole; {way_out}"
        ));
    }
    if from_first % step != 0 {
        return Err(format!(
            "finds {SLURM_INDEX} {id}, which is no step of {step} from {first}; {way_out}"
        ));
    }
    Ok(from_first / step)
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index, self.count)
    }
}

/// Returns the batch of `item` among `n_batches`.
pub fn batch_of(item: &str, n_batches: u64) -> u64 {
    range_of(stable_hash(item), n_batches)
}

/// Returns `train` (90 %), `validation` (5 %) or `test` (5 %), the same for a name everywhere.
pub fn split_of(item: &str) -> &'static str {
    match range_of(xxh3_64_with_seed(item.as_bytes(), SPLIT_SEED), 20) {
        0..18 => "train",
        18 => "validation",
        _ => "test",
    }
}

fn stable_hash(item: &str) -> u64 {
    xxh3_64_with_seed(item.as_bytes(), SHARD_SEED)
}

/// Returns which of `n` equal ranges of the 64-bit numbers holds `hash`: ⌊hash · n / 2⁶⁴⌋.
fn range_of(hash: u64, n: u64) -> u64 {
    ((u128::from(hash) * u128::from(n)) >> 64) as u64
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn none(_: &str) -> Option<String> {
        None
    }

    proptest! {
        #[test]
        fn every_item_is_in_exactly_one_shard(item in ".{0,40}", count in 1u32..40) {
            let takers = (0..count)
                .filter(|i| Shard::new(*i, count).expect("index below count").takes(&item))
                .count();
            prop_assert_eq!(takers, 1);
            let named = shard_of(&item, NonZeroU32::new(count).expect("at least 1"));
            prop_assert!(Shard::new(named, count).expect("index below count").takes(&item));
        }

        #[test]
        fn power_of_two_shards_hold_whole_batches(item in ".{1,40}", log_shards in 0u32..4) {
            let (n_shards, n_batches) = (1u64 << log_shards, 64);
            let batch = batch_of(&item, n_batches);
            prop_assert_eq!(batch / (n_batches / n_shards), batch_of(&item, n_shards));
        }

        #[test]
        fn parsing_never_panics(text in ".{0,20}") {
            Shard::parse(&text, none).ok();
        }
    }

    #[test]
    #[rustfmt::skip]
    fn hashes_never_move() {
        // From the reference xxHash library: xxhash.xxh3_64_intdigest(item, seed). A change would
        // reshuffle the splits and shards of every store.
        for (item, shard, split) in [
            ("mBR0",              0x4fa9_b2c9_5f91_67de, 0xe722_4e01_492a_b535),
            ("",                  0x2d06_8005_38d3_94c2, 0x4dc5_b0cc_826f_6703),
            ("album/song ü.flac", 0x6d40_bd89_3041_bf3b, 0x0ee1_1401_efd2_1600),
        ] {
            assert_eq!(xxh3_64_with_seed(item.as_bytes(), SHARD_SEED), shard, "{item}");
            assert_eq!(xxh3_64_with_seed(item.as_bytes(), SPLIT_SEED), split, "{item}");
        }
        assert_eq!(split_of("mBR0"), "validation");
        assert_eq!(batch_of("mBR0", 16), 4);
    }

    #[test]
    fn splits_are_ninety_five_five() {
        let n = 20_000;
        let count = |name| (0..n).filter(|i| split_of(&format!("phrase-{i}")) == name).count();
        // Three standard deviations of a binomial: 3·√(20000·0.9·0.1) = 127, 3·√(20000·0.05·0.95) = 92.
        assert!(count("train").abs_diff(18_000) <= 127, "{}", count("train"));
        assert!(count("validation").abs_diff(1_000) <= 92, "{}", count("validation"));
        assert!(count("test").abs_diff(1_000) <= 92, "{}", count("test"));
    }

    #[test]
    fn auto_reads_the_array_variables() {
        let slurm = |name: &str| match name {
            "SLURM_ARRAY_TASK_ID" => Some("7".into()),
            "SLURM_ARRAY_TASK_COUNT" => Some("5".into()),
            "SLURM_ARRAY_TASK_MIN" => Some("3".into()),
            _ => None,
        };
        assert_eq!(Shard::parse("auto", slurm).expect("a shard").to_string(), "4/5");
        // --array=0-12:4
        let stepped = |id: &'static str| {
            move |name: &str| {
                let value = match name {
                    "SLURM_ARRAY_TASK_ID" => id,
                    "SLURM_ARRAY_TASK_COUNT" | "SLURM_ARRAY_TASK_STEP" => "4",
                    "SLURM_ARRAY_TASK_MIN" => "0",
                    "SLURM_ARRAY_TASK_MAX" => "12",
                    _ => return None,
                };
                Some(value.to_owned())
            }
        };
        for (id, shard) in [("0", "0/4"), ("4", "1/4"), ("8", "2/4"), ("12", "3/4")] {
            assert_eq!(Shard::parse("auto", stepped(id)).expect("a shard").to_string(), shard);
        }
        let batch = |name: &str| match name {
            "BATCH_TASK_INDEX" => Some("0".into()),
            "BATCH_TASK_COUNT" => Some("3".into()),
            _ => None,
        };
        assert_eq!(Shard::parse("auto", batch).expect("a shard").to_string(), "0/3");
    }

    #[test]
    fn a_list_of_tasks_is_refused_with_the_way_out() {
        // --array=3,7,12: tasks of a former 0-15 that failed.
        for id in ["3", "7", "12"] {
            let list = |name: &str| {
                let value = match name {
                    "SLURM_ARRAY_TASK_ID" => id,
                    "SLURM_ARRAY_TASK_COUNT" | "SLURM_ARRAY_TASK_MIN" => "3",
                    "SLURM_ARRAY_TASK_MAX" => "12",
                    "SLURM_ARRAY_TASK_STEP" => "1",
                    _ => return None,
                };
                Some(value.to_owned())
            };
            assert_eq!(
                Shard::parse("auto", list).expect_err("a list").to_string(),
                "shard \"auto\" finds a Slurm array of 3 tasks from 3 to 12 in steps of 1, so it is a list of tasks, \
                 which does not tell the shards of the whole; submit the whole array again, since what is done is \
                 skipped, or give the shard of the former array: --shard $SLURM_ARRAY_TASK_ID/N for \
                 --array=0-(N-1); write it as i/n with 0 <= i < n, or \"auto\""
            );
        }
    }

    #[test]
    #[rustfmt::skip]
    fn bad_shards_are_refused_in_a_sentence() {
        let hint = "; write it as i/n with 0 <= i < n, or \"auto\"";
        for (text, reason) in [
            ("3",    "has no \"/\""),
            ("a/2",  "has no number in the index (\"a\")"),
            ("0/-1", "has no number in the count (\"-1\")"),
            ("2/2",  "has index 2 but only 2 shards"),
            ("0/0",  "has a count of 0"),
            ("auto", "finds none of SLURM_ARRAY_TASK_ID, JOB_COMPLETION_INDEX, BATCH_TASK_INDEX set"),
        ] {
            let error = Shard::parse(text, none).expect_err(text);
            assert_eq!(error.to_string(), format!("shard \"{text}\" {reason}{hint}"));
        }
    }
}
