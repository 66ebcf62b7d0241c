//! Vacuum: commits whose rows all were superseded are removed, with their parts, once no reader needs them any
//! more.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::time::{Duration, SystemTime};

use super::StoreError;
use super::commit::KEY_DIGITS;
use super::delta;
use super::location::{ListedObject, Location};
use super::manifest::{self, FOLDER, Manifest, Rank, stage_and_key};
use super::stage_log::StageLog;
use super::store_snapshot::checkpoint;
use super::tables;

/// Age at which a part that no manifest names is taken for abandoned, whatever is asked for: a commit under way
/// writes its parts first.
const ABANDONED: Duration = Duration::from_secs(24 * 3600);

/// The files that vacuum removes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct VacuumRemovals {
    /// Manifests and parts, below the store, in order.
    pub paths: Vec<String>,
    pub n_bytes: u64,
    /// Commits whose rows all are dead, but too recently, or that a Delta Lake log still names.
    pub n_kept: u64,
}

/// Removes what has been dead for longer than `older_than`, and parts that writers who were killed left behind; with
/// `dry_run` it tells what it would remove. A snapshot that is older loses its parts.
///
/// # Errors
/// [`StoreError`] when the store cannot be read, or refuses to remove.
pub fn vacuum(
    store: &Location,
    older_than: Duration,
    dry_run: bool,
) -> Result<VacuumRemovals, StoreError> {
    let now = SystemTime::now();
    let is_old = |time: SystemTime, age: Duration| {
        // A clock that is behind that of the storage has seen no time pass.
        now.duration_since(time).unwrap_or_default() >= age
    };
    let parts = parts_of(store)?;
    let mut done = VacuumRemovals::default();
    let mut by_stage: BTreeMap<String, Vec<(ListedObject, SystemTime)>> = BTreeMap::new();
    for (listed, time) in store.list_with_times(FOLDER)? {
        if let Some((stage, _)) = stage_and_key(&listed.path) {
            by_stage.entry(stage.to_owned()).or_default().push((listed, time));
        }
    }
    let named_by_delta = delta::active_paths(store)?;
    let mut keys: HashSet<String> = HashSet::new();
    let (mut dead, mut stages): (Vec<DeadCommit>, Vec<String>) = Default::default();
    for (stage, listed) in by_stage {
        let (listed, times): (Vec<ListedObject>, Vec<SystemTime>) = listed.into_iter().unzip();
        let manifests = manifest::read(store, &listed)?;
        keys.extend(manifests.iter().map(|manifest| manifest.key.clone()));
        let mut of_stage = Vec::new();
        for (i, since) in dead_since(&manifests, &times) {
            let (manifest, listed) = (&manifests[i], &listed[i]);
            let is_named = manifest.parts.iter().any(|part| named_by_delta.contains(&part.path));
            if is_named || !is_old(since, older_than) {
                done.n_kept += 1;
                continue;
            }
            let parts = manifest.parts.iter().map(|part| (part.path.clone(), part.n_bytes));
            let manifest = (listed.path.clone(), listed.size_bytes);
            of_stage.push(DeadCommit { manifest, parts: parts.collect() });
        }
        if !of_stage.is_empty() && !dry_run {
            // Readers whose catalogue counts what goes now would read all manifests.
            if let Err(e) = StageLog::read(store, &stage)?.checkpoint(true) {
                tracing::warn!("{store}: no catalogue of {stage} was written: {e}");
            }
            stages.push(stage);
        }
        dead.extend(of_stage);
    }
    for DeadCommit { manifest, parts: of_manifest } in dead {
        // The manifest first: a part without one is abandoned, and goes another time.
        for (path, n_bytes) in std::iter::once(manifest).chain(of_manifest) {
            remove(store, path, n_bytes, dry_run, &mut done)?;
        }
    }
    // Nor need they be told for ever of what is gone.
    checkpoint(store, &stages.iter().map(String::as_str).collect::<Vec<_>>());
    for (listed, time) in parts {
        let is_named = key_of(&listed.path).is_none_or(|key| keys.contains(key));
        if !is_named
            && is_old(time, older_than.max(ABANDONED))
            && !named_by_delta.contains(&listed.path)
            && !done.paths.contains(&listed.path)
        {
            remove(store, listed.path, listed.size_bytes, dry_run, &mut done)?;
        }
    }
    done.paths.sort();
    Ok(done)
}

/// A commit that goes: paths and sizes.
struct DeadCommit {
    manifest: (String, u64),
    parts: Vec<(String, u64)>,
}

fn remove(
    store: &Location,
    path: String,
    n_bytes: u64,
    dry_run: bool,
    done: &mut VacuumRemovals,
) -> Result<(), StoreError> {
    if !dry_run {
        store.remove(&path)?;
    }
    done.n_bytes += n_bytes;
    done.paths.push(path);
    Ok(())
}

/// Lists the parts of all tables. They are listed before the manifests, so that a part whose manifest comes
/// meanwhile is not taken for abandoned.
fn parts_of(store: &Location) -> Result<Vec<(ListedObject, SystemTime)>, StoreError> {
    let mut parts = Vec::new();
    for schema in tables::all() {
        let listed = store.list_with_times(schema.name)?;
        parts.extend(listed.into_iter().filter(|(listed, _)| key_of(&listed.path).is_some()));
    }
    Ok(parts)
}

/// Returns the key of the commit whose part lies at a path; none where the file is none of ours.
fn key_of(path: &str) -> Option<&str> {
    let (table, name) = path.split_once('/')?;
    let key = name.strip_suffix(".parquet")?;
    let is_key = key.len() == KEY_DIGITS && key.bytes().all(|b| b.is_ascii_hexdigit());
    (is_key && !table.is_empty()).then_some(key)
}

/// Returns the manifests without an item that counts, and since when.
fn dead_since(manifests: &[Manifest], times: &[SystemTime]) -> Vec<(usize, SystemTime)> {
    let headers: Vec<_> = manifests.iter().map(Manifest::headers).collect();
    let mut words: HashMap<&str, Vec<(Rank, usize)>> = HashMap::new();
    for (m, manifest) in manifests.iter().enumerate() {
        for (i, item) in manifest.items.iter().enumerate() {
            let header = &headers[m][manifest.header_of(i)];
            let rank = Rank::new(header, manifest.generation(), &manifest.key);
            words.entry(&item.id).or_default().push((rank, m));
        }
    }
    let mut counts: BTreeSet<usize> = BTreeSet::new();
    let mut since: BTreeMap<usize, SystemTime> = BTreeMap::new();
    #[expect(clippy::iter_over_hash_type, reason = "the latest of times, in any order")]
    for words in words.values_mut() {
        words.sort_unstable();
        let Some((_, latest)) = words.pop() else { continue };
        counts.insert(latest);
        // A word is dead since the first that outranks it came.
        let mut outranked = times[latest];
        for &(_, m) in words.iter().rev() {
            let known = since.entry(m).or_insert(outranked);
            *known = (*known).max(outranked);
            outranked = outranked.min(times[m]);
        }
    }
    // A commit without any item settles nothing.
    let empty = manifests.iter().enumerate().filter(|(_, manifest)| manifest.items.is_empty());
    since.extend(empty.map(|(m, _)| (m, times[m])));
    since.into_iter().filter(|(m, _)| !counts.contains(m)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::{Item, manifest::Compacted};

    fn manifest(key: &str, sequence: u64, items: &[&str]) -> Manifest {
        Manifest {
            format: 1,
            stage: "s".into(),
            key: key.into(),
            sequence,
            program: String::new(),
            params_hash: String::new(),
            origin: String::new(),
            parts: Vec::new(),
            items: items.iter().map(|id| Item::forgotten(id)).collect(),
            compacted: None,
        }
    }

    fn at(hour: u64) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_secs(3600 * hour)
    }

    #[test]
    fn a_commit_is_dead_since_its_last_item_was_first_outranked() {
        let first = manifest("a", 0, &["x", "y"]);
        let second = manifest("b", 1, &["x"]);
        let third = manifest("c", 1, &["y"]);
        // A compaction of the second and the third, and one of that.
        let compacted = |key: &str, generation| Manifest {
            compacted: Some(Compacted {
                generation,
                commits: [&second, &third].map(|m| m.headers().remove(0)).to_vec(),
                of: vec![0, 1],
            }),
            ..manifest(key, 1, &["x", "y"])
        };
        let all = [first.clone(), second.clone(), third.clone()];
        assert_eq!(dead_since(&all, &[at(1), at(2), at(5)]), [(0, at(5))]);
        assert!(dead_since(&all[..2], &[at(1), at(2)]).is_empty());
        let all = [first, second.clone(), third.clone(), compacted("d", 1), compacted("e", 2)];
        let times = [at(1), at(2), at(5), at(9), at(30)];
        let expected = [(0, at(5)), (1, at(9)), (2, at(9)), (3, at(30))];
        assert_eq!(dead_since(&all, &times), expected);
        // A copy that comes back after it was removed is as dead as it was.
        let again = [compacted("d", 1), second];
        assert_eq!(dead_since(&again, &[at(9), at(40)]), [(1, at(9))]);
    }

    #[test]
    fn names_of_ours_alone_are_parts() {
        let key = "0123456789abcdef0123456789abcdef";
        assert_eq!(key_of(&format!("motion/{key}.parquet")), Some(key));
        for path in ["motion/mine.parquet", "motion/_delta_log/0.json", "x.parquet", "motion/"] {
            assert_eq!(key_of(path), None, "{path}");
        }
        assert_eq!(key_of(&format!("motion/sub/{key}.parquet")), None);
    }
}
