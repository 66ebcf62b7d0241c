//! `library`: songs and motion captures become constructed phrases in `phrases`, `motion`, `features`
//! and `beats`.

mod captures;
mod dancers;
mod job;
mod layout;
mod made;
mod one;
mod report;
mod rows;
mod songs;
mod split;
mod store_contents;
mod survey;
mod write;

use std::num::{NonZeroU32, NonZeroUsize};
use std::path::PathBuf;
use std::time::Instant;

use super::failure::{Failure, FailureKind};
use super::touched::TouchedContent;
use super::{ClientParams, Contract, LinkParams, Progress, RARE, Stage, Summary, all_threads};
use crate::motion::Axis;
use crate::store::{Location, Source, StoreError, StoreSnapshot, checkpoint, digest};
use captures::Captures;
use dancers::DancerRange;
use job::LibraryJob;
use made::Band;
use report::{LibraryPlace, LibrarySummary, LibraryTally};
use songs::{Song, SongFiles, Songs};
use split::SongShare;
use store_contents::StoreContents;
pub(in crate::stages) use survey::{SurveyedSongs, survey};

/// Raised when library writes something else for the same inputs and parameters.
const OUTPUT_VERSION: u32 = 2;
/// The name under which songs are committed that were seen again with nothing new.
const SEEN: &str = "library-seen";
/// Where items come from that the store itself has, as commits name it.
const FROM_STORE: &str = "phrases";

/// The stage.
pub struct Library;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables. Without --songs, its phrases with audio and features are the
    /// songs; without --captures, its phrases with motion and no audio are the captures.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Folder or bucket of songs: any tree of audio files, song.beats.txt beside song.ogg.
    #[arg(long, value_name = "DIR")]
    pub songs: Option<String>,
    /// Folder or bucket of motion captures: any tree of .bvh, .npz, .npy and .vmd files (docs/guide.md).
    #[arg(long, value_name = "DIR")]
    pub captures: Option<String>,
    /// The axis that is up in motion captures of --captures [default: found, by skeletons and poses].
    #[arg(long, value_enum, value_name = "AXIS", allow_hyphen_values = true,
          hide_short_help = RARE)]
    pub up: Option<Axis>,
    /// Compose so many songs, play them, and dance to them, too: 22 styles of 70 to 180 bpm, in bars of
    /// three and four, whose beats are known. They are all for training. --seed chooses others.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub compose: u32,
    /// Folder or bucket of tunes in ABC notation (any tree of .abc files): each is given chords, bass and drums,
    /// is played, and danced to, too, for training alone.
    #[arg(long, value_name = "DIR")]
    pub tunes: Option<String>,
    /// Play composed songs and tunes with the instruments of a General MIDI soundfont (SF2), instead of our own
    /// voices.
    #[cfg(feature = "soundfont")]
    #[arg(long, value_name = "FILE", hide_short_help = RARE)]
    pub soundfont: Option<PathBuf>,
    /// Also write the songs that are composed or played in this run: NAME.wav and NAME.beats.txt.
    #[arg(long, value_name = "DIR", hide_short_help = RARE)]
    pub compose_audio: Option<PathBuf>,
    /// Also write the phrases as files, in the layout that ingest reads.
    #[arg(long, value_name = "DIR")]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub rules: LibraryRules,
    /// Songs for validation: a number, or a fraction of all (at least one). Fewer than three songs all
    /// train.
    #[arg(long, value_name = "N|FRACTION", default_value_t = SongShare::Fraction(0.1),
          hide_short_help = RARE)]
    pub validation_songs: SongShare,
    /// Songs for the test: a number, or a fraction of all (at least one).
    #[arg(long, value_name = "N|FRACTION", default_value_t = SongShare::Fraction(0.1),
          hide_short_help = RARE)]
    pub test_songs: SongShare,
    /// Songs under way at once.
    #[arg(long, value_name = "N", default_value_t = all_threads())]
    pub workers: NonZeroUsize,
    #[command(flatten)]
    pub links: LinkParams,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Do every song again, done or not.
    #[arg(long)]
    pub force: bool,
}

/// What determines the phrases beside songs and captures.
#[derive(Clone, Copy, Debug, clap::Args, serde::Serialize)]
pub struct LibraryRules {
    /// Dances per song, each another choice of steps and turns.
    #[arg(long, value_name = "N", default_value_t = NonZeroU32::new(8).expect("8 is not 0"))]
    pub takes: NonZeroU32,
    /// Length of a phrase, in frames at 30 fps.
    #[arg(long, value_name = "FRAMES",
          default_value_t = NonZeroUsize::new(120).expect("120 is not 0"), hide_short_help = RARE)]
    pub phrase_frames: NonZeroUsize,
    /// From the begin of a phrase to that of the next, in frames.
    #[arg(long, value_name = "FRAMES",
          default_value_t = NonZeroUsize::new(60).expect("60 is not 0"), hide_short_help = RARE)]
    pub hop_frames: NonZeroUsize,
    /// Dancers of a take, a number or a range that chance draws from for each take, such as 2..5: groups in
    /// formations, their steps the same, mirrored, in canon, as call and response, or free (docs/groups.md)
    /// [default: soloists].
    #[arg(long, value_name = "MIN..MAX")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dancers: Option<DancerRange>,
    /// Chooses other dances of the same songs and captures.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

impl Stage for Library {
    const NAME: &'static str = "library";
    const ABOUT: &'static str = "construct phrases to train on from songs and motion captures";
    const CONTRACT: Contract = Contract {
        reads: "phrases, features, beats and motion, or folders of songs and captures",
        writes: "phrases, motion, features, beats, failures, or also a phrase layout",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        let options = params.client.options();
        let store = Location::open(&params.store, &options)?;
        let snapshot = StoreSnapshot::take(&store)?;
        let mut known = StoreContents::read(&snapshot)?;
        let ledger = snapshot.ledger(Self::NAME)?;
        let seen = TouchedContent::read(&store, SEEN)?;
        let open = |url: &str| {
            Source::open(url, &options, None)
                .map(|source| source.following_links(params.links.follow_links))
        };
        let captures = match &params.captures {
            Some(url) => Captures::of_folder(open(url)?, params.up)?,
            None => Captures::of_store(&snapshot, &known),
        };
        let mut songs = match &params.songs {
            Some(url) => Songs::of_folder(open(url)?, &known)?,
            None => {
                let is_needed = params.compose == 0 && params.tunes.is_none();
                Songs::of_store(&snapshot, &mut known, is_needed)?
            }
        };
        #[cfg(feature = "soundfont")]
        let band = Band::of(params.soundfont.as_deref())?;
        #[cfg(not(feature = "soundfont"))]
        let band = Band::default();
        songs.songs.extend(made::composed(params.compose, params.rules.seed, &band));
        if let Some(url) = &params.tunes {
            songs.songs.extend(made::tunes(&open(url)?, params.rules.seed, &band)?);
        }
        prepare(&mut songs, &params)?;
        let job =
            LibraryJob { store: &store, ledger, seen, known, band, params: &params, progress };
        let mut report = LibrarySummary {
            place: LibraryPlace { store: store.to_string(), output: params.output.clone() },
            dry_run: params.dry_run,
            splits: splits(&songs.songs),
            n_without_features: songs.n_without_features,
            tally: LibraryTally::default(),
            took_s: 0.0,
        };
        job.run(captures, &songs, &mut report)?;
        if !params.dry_run {
            checkpoint(&store, &[Self::NAME]);
        }
        report.took_s = started.elapsed().as_secs_f64();
        report.tally.failed.sort_by(|a, b| a.0.cmp(&b.0));
        Ok(Box::new(report))
    }
}

/// Names what is wrong with songs already, and splits the others.
fn prepare(songs: &mut Songs, params: &Params) -> anyhow::Result<()> {
    songs.refuse_namesakes();
    let length = params.rules.phrase_frames.get();
    for song in songs.songs.iter_mut().filter(|song| song.problem.is_none()) {
        if let SongFiles::Store { n_frames, .. } = &song.files
            && *n_frames < length
        {
            song.problem = Some(one::too_short(song, *n_frames, length));
        }
    }
    // A song that cannot be danced to takes no place in a split, unless it only waits for its features.
    let takes_place = |song: &&Song| {
        song.problem.as_ref().is_none_or(|failure| failure.kind == FailureKind::StaleFeatures)
    };
    // Music of our own is for training: a verdict rests on real songs.
    let real = songs.songs.iter().filter(takes_place).filter(|song| !song.is_made());
    let names: Vec<String> = real.map(|song| song.id.clone()).collect();
    let split_of_song =
        split::assign(names.iter().map(String::as_str), params.validation_songs, params.test_songs)
            .map_err(anyhow::Error::msg)?;
    for song in &mut songs.songs {
        song.split = split_of_song.get(song.id.as_str()).copied().unwrap_or(split::TRAIN);
    }
    if names.is_empty() {
        tracing::warn!("no song is real, so none is for validation and for the test");
    } else if names.len() < 3 {
        tracing::warn!("{} songs are too few to split: all of them are for training", names.len());
    }
    Ok(())
}

/// Counts the songs of every split.
fn splits(songs: &[Song]) -> [(usize, &'static str); 3] {
    [split::TRAIN, split::VALIDATION, split::TEST].map(|name| {
        let n = songs.iter().filter(|s| s.problem.is_none() && s.split == name).count();
        (n, name)
    })
}

/// Returns the failure of a file that could not be read.
fn unreadable(path: &str, error: &StoreError) -> Failure {
    let cause = std::error::Error::source(error).map(|e| format!(" ({e})")).unwrap_or_default();
    Failure::new(FailureKind::Unreadable, path, format!("{error}{cause}"))
}

/// Returns the digest of everything but the inputs that determines library's output.
fn params_hash(rules: &LibraryRules) -> String {
    let text = serde_json::json!({ "output_version": OUTPUT_VERSION, "rules": rules });
    digest(text.to_string().as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_that_are_not_given_leave_their_digest_as_it_was() {
        let mut rules = LibraryRules {
            takes: NonZeroU32::new(3).unwrap(),
            phrase_frames: NonZeroUsize::new(120).unwrap(),
            hop_frames: NonZeroUsize::new(60).unwrap(),
            dancers: None,
            seed: 7,
        };
        // What is digested is this text, in an order that other crates of a build may change.
        let text = |rules: &LibraryRules| serde_json::to_string(rules).unwrap();
        assert_eq!(text(&rules), r#"{"takes":3,"phrase_frames":120,"hop_frames":60,"seed":7}"#);
        let soloists = params_hash(&rules);
        rules.dancers = Some("2..5".parse().unwrap());
        assert_eq!(
            text(&rules),
            r#"{"takes":3,"phrase_frames":120,"hop_frames":60,"dancers":"2..5","seed":7}"#
        );
        assert_ne!(params_hash(&rules), soloists);
    }
}
