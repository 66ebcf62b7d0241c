//! Which files make which phrase: a listing becomes a plan, without reading a file.

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};

use crate::audio::formats::is_audio_extension as is_audio;
use crate::motion::group::MAX_DANCERS;
use crate::store::{Listing, SourceFile, SourceProblem, SourceProblemKind};

use super::motion::CAPTURE_EXTENSIONS;
use crate::stages::failure::{Failure, FailureKind};

const BEATS_SUFFIX: &str = ".beats.txt";
/// File that names the style of a phrase's motion.
const STYLE_FILE: &str = "style.txt";
/// How the files of a group's dancers are called, before their number.
const DANCER_PREFIX: &str = "dancer_";
/// Endings of such names.
const DANCER_EXTENSIONS: [&str; 2] = ["npy", "bvh"];

/// How a source is organised.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Layout {
    /// Phrases if the source has `motion/` or `audio_features/`, or nothing but `audio/` and
    /// `beats/`; else a music library.
    Auto,
    /// `motion/ID/trajectory.npy` or `motion.bvh` (or `.npz`, `.npy`, `.vmd`), of a group also `dancer_0.npy` (or
    /// `.bvh`), `dancer_1.npy` and so on, and `style.txt`, the name of its style; `audio_features/ID/features.npz`, `audio/ID.wav`, `beats/ID.beats.txt`.
    Phrases,
    /// Any tree of audio files; a phrase's id is its relative path, extension included.
    Library,
}

/// The role of a file in its phrase.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Role {
    Audio,
    Beats,
    Features,
    MotionCapture,
    MotionNpy,
    /// Motion of one dancer of a group, by number.
    Dancer(u32),
    /// The name of the motion's style.
    Style,
}

impl Role {
    /// Returns the role's name, which digests and messages use.
    pub fn name(self) -> &'static str {
        match self {
            Role::Audio => "audio",
            Role::Beats => "beats",
            Role::Features => "features",
            Role::MotionCapture | Role::MotionNpy | Role::Dancer(_) => "motion",
            Role::Style => "style",
        }
    }
}

/// A phrase to ingest, or the reason why it cannot even be tried.
#[derive(Clone, Debug, PartialEq)]
pub struct PlannedPhrase {
    pub id: String,
    /// The phrase's files, sorted by role.
    pub files: Vec<(Role, SourceFile)>,
    pub problem: Option<Box<Failure>>,
}

/// Everything that a source offers, phrases sorted by id.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct IngestPlan {
    pub phrases: Vec<PlannedPhrase>,
    /// Files that belong to no phrase.
    pub ignored: Vec<String>,
}

/// Assigns every file of a listing to a phrase, to the ignored files, or to a failure.
pub fn plan(listing: Listing, layout: Layout) -> IngestPlan {
    let phrases = match layout {
        Layout::Phrases => true,
        Layout::Library => false,
        Layout::Auto => looks_like_phrases(&listing),
    };
    let mut drafts = Drafts::default();
    if phrases {
        phrase_layout(listing, &mut drafts);
    } else {
        library_layout(listing, &mut drafts);
    }
    drafts.finish()
}

fn looks_like_phrases(listing: &Listing) -> bool {
    let paths = || {
        let files = listing.files.iter().map(|f| f.path.as_str());
        let problems = listing.problems.iter().map(|p| p.path.as_str());
        files.chain(problems).chain(listing.folders.iter().map(String::as_str))
    };
    let below = |path: &str, folder: &str| {
        path.strip_prefix(folder).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
    };
    let has = |folder| paths().any(|path| below(path, folder));
    let known = |path: &str| extension(path).is_some_and(is_audio) || path.ends_with(BEATS_SUFFIX);
    has("motion")
        || has("audio_features")
        || has("audio")
            && paths()
                .filter(|path| known(path))
                .all(|path| below(path, "audio") || below(path, "beats"))
}

fn phrase_layout(listing: Listing, drafts: &mut Drafts) {
    let lacking = lacking_files(&listing);
    for folder in listing.folders {
        // The contents of a folder whose name is that of a phrase's file belong to no phrase.
        if let Some((id, _)) = phrase_slot(&folder) {
            drafts.fail(id.to_owned(), not_a_file(&folder));
        }
    }
    for file in listing.files {
        match phrase_slot(&file.path) {
            Some((id, role)) => drafts.add(id.to_owned(), role, file),
            None => drafts.ignored.push(file.path),
        }
    }
    for problem in listing.problems {
        let id = phrase_slot(&problem.path).map(|(id, _)| id.to_owned());
        let id = id.or_else(|| phrase_folder(&problem.path).map(|(id, _)| id.to_owned()));
        drafts.problem(id, problem);
    }
    for (id, failure) in lacking {
        drafts.fail(id, failure);
    }
}

/// Returns the phrases whose folder of `motion/` or `audio_features/` lacks the phrase's file.
///
/// Paths are borrowed and kept in sorted lists: a source may have a million folders.
fn lacking_files(listing: &Listing) -> Vec<(String, Failure)> {
    // Folders that must hold a phrase's file.
    let mut expecting: Vec<&str> = Vec::new();
    // Folders that need nothing more, and those that are a phrase's own or are called like a phrase's file.
    let (mut filled, mut taken): (Vec<&str>, Vec<&str>) = (Vec::new(), Vec::new());
    for folder in &listing.folders {
        let is_parent = any_below(&listing.folders, String::as_str, folder);
        if phrase_folder(folder).is_some() && !is_parent {
            expecting.push(folder);
        }
        if phrase_slot(folder).is_some() {
            filled.extend(parent(folder));
            taken.push(folder);
        }
    }
    for file in &listing.files {
        let Some(folder) = parent(&file.path).filter(|folder| phrase_folder(folder).is_some())
        else {
            continue;
        };
        expecting.push(folder);
        match phrase_slot(&file.path) {
            // The name of a style is no motion.
            None | Some((_, Role::Style)) => {}
            Some(_) => {
                filled.push(folder);
                taken.push(folder);
            }
        }
    }
    for problem in &listing.problems {
        filled.extend(parent(&problem.path));
        filled.push(&problem.path);
    }
    for folders in [&mut expecting, &mut filled, &mut taken] {
        folders.sort_unstable();
        folders.dedup();
    }
    let has = |folders: &[&str], folder: &str| folders.binary_search(&folder).is_ok();
    let lacks = |folder: &&str| {
        // A folder inside a phrase's own holds extras, which are left alone.
        !has(&filled, folder) && !at_and_above(folder).any(|above| has(&taken, above))
    };
    let lacking = expecting.iter().filter(|folder| lacks(folder));
    lacking
        .filter_map(|folder| {
            let (id, expects) = phrase_folder(folder)?;
            let message =
                format!("folder {folder} holds no {expects}; add it or remove the folder");
            Some((id.to_owned(), Failure::new(FailureKind::Layout, folder, message)))
        })
        .collect()
}

fn parent(path: &str) -> Option<&str> {
    path.rsplit_once('/').map(|(parent, _)| parent)
}

/// Returns the phrase and role that a path of the phrase layout stands for.
fn phrase_slot(path: &str) -> Option<(&str, Role)> {
    let (top, rest) = path.split_once('/')?;
    let in_folder = |file: &str| rest.strip_suffix(file)?.strip_suffix('/');
    let slot = match top {
        "motion" => in_folder("trajectory.npy").map(|id| (id, Role::MotionNpy)).or_else(|| {
            if let Some(id) = in_folder(STYLE_FILE) {
                return Some((id, Role::Style));
            }
            let (stem, ending) = rest.rsplit_once('.')?;
            if let Some(id) = stem.strip_suffix("/motion") {
                return CAPTURE_EXTENSIONS.contains(&ending).then_some((id, Role::MotionCapture));
            }
            let (id, name) = stem.rsplit_once('/')?;
            let number = name.strip_prefix(DANCER_PREFIX)?;
            let is_number = number.bytes().all(|digit| digit.is_ascii_digit());
            let number = number.parse().ok().filter(|_| is_number)?;
            DANCER_EXTENSIONS.contains(&ending).then_some((id, Role::Dancer(number)))
        }),
        "audio_features" => in_folder("features.npz").map(|id| (id, Role::Features)),
        "beats" => Some((rest.strip_suffix(BEATS_SUFFIX)?, Role::Beats)),
        "audio" => match rest.strip_suffix(BEATS_SUFFIX) {
            Some(id) => Some((id, Role::Beats)),
            None => {
                let extension = extension(rest).filter(|e| is_audio(e))?;
                Some((&rest[..rest.len() - extension.len() - 1], Role::Audio))
            }
        },
        _ => None,
    };
    // `._song.wav` and its like are what some systems leave beside a file, not a file of their own.
    let hidden = |id: &str| id.rsplit('/').next().is_some_and(|name| name.starts_with('.'));
    slot.filter(|(id, role)| {
        let beside = matches!(role, Role::Audio | Role::Beats);
        !(id.is_empty() || id.ends_with('/') || beside && hidden(id))
    })
}

/// Returns the phrase whose folder this is, and what the folder must hold.
fn phrase_folder(path: &str) -> Option<(&str, &'static str)> {
    let (top, id) = path.split_once('/')?;
    let expects = match top {
        "motion" => "trajectory.npy or motion.bvh (or .npz, .npy, .vmd)",
        "audio_features" => "features.npz",
        _ => return None,
    };
    Some((id, expects))
}

fn library_layout(listing: Listing, drafts: &mut Drafts) {
    let stem = |path: &str| path.rsplit_once('.').map(|(stem, _)| stem.to_owned());
    for folder in listing.folders.iter().filter(|f| extension(f).is_some_and(is_audio)) {
        // A folder may be called `live.wav` for all that we know, as long as it holds something.
        let holds = any_below(&listing.files, |f| &f.path, folder)
            || any_below(&listing.folders, String::as_str, folder);
        if !holds {
            drafts.fail(folder.clone(), not_a_file(folder));
        }
    }
    let mut beats: BTreeMap<String, SourceFile> = BTreeMap::new();
    let mut songs = Vec::new();
    for file in listing.files {
        let hidden = file.path.rsplit('/').next().is_some_and(|name| name.starts_with('.'));
        if let (Some(stem), false) = (file.path.strip_suffix(BEATS_SUFFIX), hidden) {
            beats.insert(stem.to_owned(), file);
        } else if !hidden && extension(&file.path).is_some_and(is_audio) {
            songs.push(file);
        } else {
            drafts.ignored.push(file.path);
        }
    }
    let with_song: BTreeSet<String> = songs.iter().filter_map(|s| stem(&s.path)).collect();
    for song in songs {
        let id = song.path.clone();
        if let Some(file) = stem(&id).and_then(|stem| beats.get(&stem)) {
            drafts.add(id.clone(), Role::Beats, file.clone());
        }
        drafts.add(id, Role::Audio, song);
    }
    let lone = beats.into_iter().filter(|(stem, _)| !with_song.contains(stem));
    drafts.ignored.extend(lone.map(|(_, file)| file.path));
    for problem in listing.problems {
        drafts.problem(None, problem);
    }
}

/// Phrases of a plan under construction, in the order in which they are found.
#[derive(Default)]
struct Drafts {
    /// The id of a phrase, and what is known of it.
    entries: Vec<(String, Draft)>,
    ignored: Vec<String>,
}

enum Draft {
    File(Role, SourceFile),
    Problem(Box<Failure>),
}

impl Drafts {
    fn add(&mut self, id: String, role: Role, file: SourceFile) {
        self.entries.push((id, Draft::File(role, file)));
    }

    fn fail(&mut self, id: String, failure: Failure) {
        self.entries.push((id, Draft::Problem(Box::new(failure))));
    }

    fn problem(&mut self, id: Option<String>, problem: SourceProblem) {
        let kind = match problem.kind {
            SourceProblemKind::Name => FailureKind::Name,
            SourceProblemKind::NotAFile => FailureKind::NotAFile,
            SourceProblemKind::Symlink => FailureKind::Symlink,
            SourceProblemKind::Unreadable => FailureKind::Unreadable,
        };
        let message = format!("{} {}", problem.path, problem.message);
        let failure = Failure::new(kind, &problem.path, message);
        self.fail(id.unwrap_or(problem.path), failure);
    }

    fn finish(mut self) -> IngestPlan {
        // Of several problems of a phrase the first counts, so that the sort has to be stable.
        self.entries.sort_by(|a, b| a.0.cmp(&b.0));
        let is_first = |i: usize| i == 0 || self.entries[i].0 != self.entries[i - 1].0;
        let n_phrases = (0..self.entries.len()).filter(|&i| is_first(i)).count();
        let mut phrases: Vec<PlannedPhrase> = Vec::with_capacity(n_phrases);
        for (id, draft) in self.entries {
            if phrases.last().is_none_or(|last| last.id != id) {
                phrases.push(PlannedPhrase { id, files: Vec::new(), problem: None });
            }
            let Some(phrase) = phrases.last_mut() else { continue };
            match draft {
                Draft::File(role, file) => {
                    // Most phrases have one file or two, and a plan may have a million phrases.
                    phrase.files.reserve_exact(1);
                    phrase.files.push((role, file));
                }
                Draft::Problem(failure) => {
                    phrase.problem.get_or_insert(failure);
                }
            }
        }
        for phrase in &mut phrases {
            phrase.files.sort_by(|a, b| (a.0, &a.1.path).cmp(&(b.0, &b.1.path)));
            if phrase.problem.is_none() {
                phrase.problem = conflict(phrase).map(Box::new);
            }
        }
        self.ignored.sort();
        IngestPlan { phrases, ignored: self.ignored }
    }
}

/// Returns why the files of a phrase cannot be one phrase.
fn conflict(phrase: &PlannedPhrase) -> Option<Failure> {
    for pair in phrase.files.windows(2) {
        let [(a_role, a), (b_role, b)] = pair else { continue };
        let are_two_dancers =
            matches!((a_role, b_role), (Role::Dancer(a), Role::Dancer(b)) if a != b);
        if a_role.name() == b_role.name() && !are_two_dancers {
            let message = format!(
                "{} comes twice, from {} and {}; keep one of them",
                a_role.name(),
                a.path,
                b.path
            );
            return Some(Failure::new(FailureKind::DuplicateId, &b.path, message));
        }
    }
    if let Some(failure) = missing_dancer(phrase) {
        return Some(failure);
    }
    if let [(Role::Beats, beats)] = phrase.files.as_slice() {
        let message = format!(
            "{} stands alone, without audio, motion or features; add one of them or remove it",
            beats.path
        );
        return Some(Failure::new(FailureKind::Layout, &beats.path, message));
    }
    None
}

/// Returns why the files of a group are not those of the dancers 0, 1, 2 and so on.
fn missing_dancer(phrase: &PlannedPhrase) -> Option<Failure> {
    let dancers = phrase.files.iter().filter_map(|(role, file)| match role {
        Role::Dancer(number) => Some((*number as usize, file)),
        _ => None,
    });
    let dancers: Vec<(usize, &SourceFile)> = dancers.collect();
    let (_, last) = dancers.last()?;
    let folder = parent(&last.path).unwrap_or(&last.path);
    let refused = |message: String| Some(Failure::new(FailureKind::Layout, folder, message));
    if dancers.len() > MAX_DANCERS {
        return refused(group_too_large(folder, dancers.len()));
    }
    let missing = (0..dancers.len()).find(|&i| dancers[i].0 != i)?;
    refused(format!(
        "folder {folder} has {}, but no {DANCER_PREFIX}{missing}; number the dancers of a group 0, 1, 2 and so on",
        last.path.rsplit('/').next().unwrap_or(&last.path)
    ))
}

/// Says that a group has more dancers than one may have.
pub(super) fn group_too_large(place: &str, n_dancers: usize) -> String {
    format!(
        "{place} has {n_dancers} dancers, more than the {MAX_DANCERS} of a group; split it into several phrases"
    )
}

fn not_a_file(folder: &str) -> Failure {
    let message = format!("{folder} is a folder where a file is expected; rename or remove it");
    Failure::new(FailureKind::NotAFile, folder, message)
}

/// Returns whether a listing, sorted by path, has anything below a folder.
fn any_below<T>(listed: &[T], path: impl Fn(&T) -> &str, folder: &str) -> bool {
    let start = format!("{folder}/");
    let first = listed.partition_point(|item| path(item) < start.as_str());
    listed.get(first).is_some_and(|item| path(item).starts_with(&start))
}

/// Returns a path and the folders above it, the nearest first.
fn at_and_above(path: &str) -> impl Iterator<Item = &str> {
    std::iter::successors(Some(path), |path| path.rsplit_once('/').map(|(above, _)| above))
}

fn extension(path: &str) -> Option<&str> {
    let name = path.rsplit('/').next()?;
    name.rsplit_once('.').map(|(_, extension)| extension)
}
