//! `ingest` and `query` through the program, from buckets into buckets: rows, kills, faults,
//! refusals, cache.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;
use std::time::Duration;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::write;
use motiongen::store::tables::{FailureRow, PhraseRow};
use motiongen::store::{Location, Row as _, Snapshot, split_of};

use crate::ingest_kill::{Contents, Running};
use crate::servers::faults::Faults;
use crate::servers::gcs_translator::percent_decode;
use crate::servers::http::Request;
use crate::servers::{self, Loopback};
use crate::support::files::{beats, coherent, features_npz, trajectory, wav};
use crate::support::{Output, finish, motiongen};

/// A bucket with phrases in it and room for stores.
struct RemoteIngest {
    stores: Loopback,
    bucket: String,
}

/// What a sound phrase must become.
#[derive(Debug, PartialEq)]
struct Expected {
    n_frames: i64,
    duration_s: f64,
    has_audio: bool,
    has_features: bool,
    tempo_bpm: Option<f64>,
}

impl RemoteIngest {
    fn start(stores: Option<Loopback>, label: &str) -> Option<Self> {
        let stores = stores?;
        let bucket = stores.create_bucket(label);
        Some(Self { stores, bucket })
    }

    fn url(&self, folder: &str) -> String {
        self.stores.url(&self.bucket, folder)
    }

    fn location(&self, folder: &str) -> Location {
        Location::with_client(&self.url(folder), self.stores.client(&self.bucket), folder)
    }

    /// Puts `n` phrases into the bucket, every `broken_every`th of which cannot be read.
    fn write_source(
        &self,
        n: usize,
        broken_every: usize,
    ) -> BTreeMap<String, Result<Expected, &'static str>> {
        let source = self.location("source");
        let put = |path: String, bytes: Vec<u8>| {
            source.put_new(&path, bytes.into()).unwrap_or_else(|e| panic!("{path}: {e}"));
        };
        let phrase = |i: usize| {
            // Half seconds, whose sums are exact.
            let n_frames = 15 * (1 + i * 5 % 4);
            let duration_s = n_frames as f64 / 30.0;
            // One phrase in four is in one of the small splits.
            let mut names = (0..).map(|k| format!("set {}/ü-{i:03}{}", i % 3, "'".repeat(k)));
            let fits = |id: &String| i % 4 != 1 || split_of(id) != "train";
            let id = names.find(fits).expect("a name without end");
            let mut frames = coherent(n_frames, i as u32);
            let broken = broken_every > 0 && i % broken_every == 2;
            let mut bytes = trajectory(&frames);
            let mut kind = "non_finite";
            match (broken, i % 4) {
                (false, _) => {}
                (true, 0) => {
                    frames[7][2] = f32::INFINITY;
                    bytes = trajectory(&frames);
                }
                (true, 1) => {
                    kind = "shape";
                    bytes = write(&[MOTION_DIM, n_frames], frames.as_flattened());
                }
                (true, 2) => {
                    kind = "truncated";
                    bytes.truncate(bytes.len() - 13);
                }
                (true, _) => {
                    kind = "quaternion_norm";
                    frames[0][9..13].copy_from_slice(&[0.5, 0.0, 0.0, 0.25]);
                    bytes = trajectory(&frames);
                }
            }
            put(format!("motion/{id}/trajectory.npy"), bytes);
            let mut expected = Expected {
                n_frames: n_frames as i64,
                duration_s,
                has_audio: false,
                has_features: false,
                tempo_bpm: None,
            };
            if i.is_multiple_of(5) {
                put(format!("audio/{id}.wav"), wav(duration_s));
                put(format!("audio/{id}.beats.txt"), beats(5, 120.0, Some(4)).into_bytes());
                (expected.has_audio, expected.tempo_bpm) = (true, Some(120.0));
            }
            if i % 7 == 3 {
                put(format!("audio_features/{id}/features.npz"), features_npz(n_frames));
                expected.has_features = true;
                expected.tempo_bpm = expected.tempo_bpm.or(Some(97.5));
            }
            (id, if broken { Err(kind) } else { Ok(expected) })
        };
        (0..n).map(phrase).collect()
    }

    fn ingest(&self, store: &str, more: &[&str]) -> Command {
        let mut command = motiongen();
        self.stores.env().apply(&mut command);
        command.args(["ingest", "--source", &self.url("source"), "--store", &self.url(store)]);
        command.args(more);
        command
    }

    fn query(&self, store: &str, more: &[&str]) -> Output {
        let mut command = motiongen();
        self.stores.env().apply(&mut command);
        finish(command.args(["query", "--store", &self.url(store)]).args(more))
    }

    /// Returns method and path below the bucket of every request since the first `skip`.
    fn requests(&self, skip: usize) -> Vec<(String, String)> {
        let folder = format!("/{}", self.bucket);
        let below = |r: &Request| {
            let path = percent_decode(r.target.split('?').next().unwrap_or_default());
            let below = path.strip_prefix(&folder).unwrap_or(&path).trim_start_matches('/');
            (r.method.clone(), below.to_owned())
        };
        self.stores.requests()[skip..].iter().map(below).collect()
    }

    /// Returns the source files fetched since the first `skip` requests.
    fn fetched(&self, skip: usize) -> Vec<String> {
        let gets = self.requests(skip).into_iter().filter(|(method, _)| method == "GET");
        gets.filter_map(|(_, path)| path.strip_prefix("source/").map(str::to_owned)).collect()
    }

    /// Returns the paths written since the first `skip` requests.
    fn written(&self, skip: usize) -> Vec<String> {
        let all = self.requests(skip).into_iter();
        all.filter(|(method, _)| method != "GET" && method != "HEAD").map(|(_, p)| p).collect()
    }

    fn contents(&self, store: &str) -> Contents {
        Contents::of(&self.location(store))
    }
}

fn rows_of(store: &Location) -> BTreeMap<String, PhraseRow> {
    let snapshot = Snapshot::take(store, PhraseRow::schema()).expect("a snapshot");
    let rows = snapshot.rows::<PhraseRow>().expect("rows");
    let n_rows = rows.len();
    let rows: BTreeMap<_, _> = rows.into_iter().map(|r| (r.phrase_id.clone(), r)).collect();
    assert_eq!(rows.len(), n_rows, "a phrase has two rows");
    rows
}

fn failure_kinds(store: &Location) -> BTreeMap<String, String> {
    let snapshot = Snapshot::take(store, FailureRow::schema()).expect("a snapshot");
    let rows = snapshot.rows::<FailureRow>().expect("rows");
    rows.into_iter().map(|r| (r.phrase_id, r.kind)).collect()
}

#[test]
fn gs_phrases_become_rows_and_broken_ones_failures() {
    let Some(job) = RemoteIngest::start(servers::gs(), "rows") else { return };
    let source = job.write_source(61, 11);
    let output = finish(&mut job.ingest("tables/ä", &[]));
    assert_eq!(output.code, 1, "{output:?}");
    let first = format!("ingest {} → {}\n", job.url("source"), job.url("tables/ä"));
    assert!(output.stdout.starts_with(&first), "{}", output.stdout);
    assert!(output.stdout.contains("  55 ingested ("), "{}", output.stdout);
    assert!(output.stdout.contains(", 0 up to date, 6 failed; "), "{}", output.stdout);

    let store = job.location("tables/ä");
    let rows = rows_of(&store);
    for (id, expected) in &source {
        let row = rows.get(id);
        let Ok(expected) = expected else {
            assert!(row.is_none(), "{id} is broken");
            continue;
        };
        let row = row.unwrap_or_else(|| panic!("{id} has no row"));
        let found = Expected {
            n_frames: row.n_frames.unwrap_or(0),
            duration_s: row.duration_s,
            has_audio: row.has_audio,
            has_features: row.has_features,
            tempo_bpm: row.tempo_bpm,
        };
        assert_eq!(found, *expected, "{id}");
        assert_eq!(row.source, job.url("source"));
        let motion_url = format!("{}/motion/{id}/trajectory.npy", job.url("source"));
        assert_eq!(row.motion_url, Some(motion_url));
        assert_eq!(row.motion_bytes, Some(128 + 100 * expected.n_frames), "{id}");
        assert_eq!(row.split, split_of(id), "{id}");
    }
    let broken = source.into_iter().filter_map(|(id, e)| Some((id, e.err()?.to_owned())));
    assert_eq!(failure_kinds(&store), broken.collect::<BTreeMap<_, _>>());
    // Names and sizes agree with the commits, and nothing else is in the store.
    job.contents("tables/ä");

    // What failed is read again, because it may have been repaired; nothing is written.
    let before = job.stores.requests().len();
    let again = finish(&mut job.ingest("tables/ä", &[]));
    assert_eq!(again.code, 1, "{again:?}");
    assert!(again.stdout.contains("55 up to date, 6 failed; "), "{}", again.stdout);
    assert_eq!(job.written(before), [""; 0]);
    let kinds = failure_kinds(&store);
    let of_broken = |path: &String| kinds.keys().any(|id| path.contains(id.as_str()));
    assert!(job.fetched(before).iter().all(of_broken), "{:?}", job.fetched(before));
}

#[test]
fn a_second_run_over_a_sound_source_fetches_and_writes_nothing() {
    for stores in [servers::s3(), servers::gs()] {
        let Some(job) = RemoteIngest::start(stores, "again") else { return };
        job.write_source(13, 0);
        let output = finish(&mut job.ingest("tables", &[]));
        assert_eq!(output.code, 0, "{output:?}");
        let before = job.stores.requests().len();
        let output = finish(&mut job.ingest("tables", &[]));
        let expected = format!(
            "ingest {} → {}\n  nothing to do: 13 phrases are up to date\n",
            job.url("source"),
            job.url("tables")
        );
        assert_eq!((output.code, output.stdout), (0, expected));
        assert_eq!(job.fetched(before), [""; 0]);
        assert_eq!(job.written(before), [""; 0]);
    }
}

/// Kills a run over `n` phrases after some commits, twice, runs it to its end, and compares.
fn kill_and_resume(stores: Option<Loopback>, n: usize) {
    let Some(job) = RemoteIngest::start(stores, "kill") else { return };
    let broken = job.write_source(n, 9).into_values().filter(Result::is_err).count();
    let flags = ["--batch-phrases", "4", "--workers", "1"];
    let output = finish(&mut job.ingest("whole", &flags));
    assert_eq!(output.code, i32::from(broken > 0), "{output:?}");
    let whole = job.contents("whole");

    // Slow enough for the kills to come in time.
    let slow = Faults { delay_ms: 15, ..Faults::default() };
    job.stores.inject(slow.only(|method, _| method == "PUT"));
    let n_commits = || job.location("killed").list("commits").expect("a listing").len();
    for enough in [2, 3] {
        let mut running = Running::start(job.ingest("killed", &flags));
        while n_commits() < enough && running.is_running() {
            std::thread::sleep(Duration::from_millis(3));
        }
        assert!(running.kill(), "the run was over before it was killed");
    }
    job.stores.inject(Faults::default());
    let before = (n_commits(), job.stores.requests().len());
    assert!(before.0 >= 3 && before.0 < whole.manifests.len(), "{before:?}");
    let output = finish(&mut job.ingest("killed", &flags));
    assert_eq!(output.code, i32::from(broken > 0), "{output:?}");
    job.contents("killed").assert_same_as(&whole);
    // Finished batches were left alone.
    let committed = job.written(before.1).into_iter().filter(|path| path.contains("/commits/"));
    assert_eq!(committed.count(), whole.manifests.len() - before.0);
}

#[test]
fn a_gs_run_killed_twice_and_resumed_ends_like_one_that_was_not() {
    kill_and_resume(servers::gs(), 61);
}

#[test]
fn an_s3_run_killed_twice_and_resumed_ends_like_one_that_was_not() {
    kill_and_resume(servers::s3(), 23);
}

#[test]
fn throttling_failures_delays_and_broken_lines_change_nothing_but_the_time() {
    for stores in [servers::gs(), servers::s3()] {
        let Some(job) = RemoteIngest::start(stores, "faults") else { return };
        job.write_source(17, 9);
        assert_eq!(finish(&mut job.ingest("whole", &["--batch-phrases", "6"])).code, 1);
        job.stores.inject(Faults {
            drop_connection_first: 1,
            too_many_requests_first: 1,
            server_error_first: 1,
            delay_ms: 3,
            ..Faults::default()
        });
        let output = finish(&mut job.ingest("faulty", &["--batch-phrases", "6"]));
        assert_eq!(output.code, 1, "{output:?}");
        // Every object of the source three times at least.
        assert!(job.stores.injected() > 3 * 17, "{}", job.stores.injected());
        job.stores.inject(Faults::default());
        job.contents("faulty").assert_same_as(&job.contents("whole"));
    }
}

/// Returns the hint that a refused request comes with.
fn hint(job: &RemoteIngest) -> &'static str {
    match job.stores.scheme {
        servers::Scheme::S3 => {
            "; access was refused: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY to a key that \
             may do this: "
        }
        servers::Scheme::Gs => {
            "; access was refused: set GOOGLE_APPLICATION_CREDENTIALS to a key file that may do \
             this: "
        }
    }
}

#[test]
fn a_store_that_refuses_ends_the_run_with_its_place_and_what_to_set() {
    for stores in [servers::gs(), servers::s3()] {
        let Some(job) = RemoteIngest::start(stores, "deny") else { return };
        job.write_source(3, 0);
        let url = job.url("tables");
        job.stores.inject(Faults { deny: true, ..Faults::default() });
        let output = finish(&mut job.ingest("tables", &[]));
        // The source comes first.
        let start = format!("error: {}: could not list{}", job.url("source"), hint(&job));
        assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{}", output.stderr);
        assert!(output.stderr.starts_with(&start), "{}", output.stderr);

        let writes = |method: &str, path: &str| method != "GET" && path.contains("/tables/");
        job.stores.inject(Faults { deny: true, ..Faults::default() }.only(writes));
        let output = finish(&mut job.ingest("tables", &[]));
        assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{}", output.stderr);
        let (start, end) =
            (format!("error: {url}/beats/"), format!("could not write{}", hint(&job)));
        assert!(output.stderr.starts_with(&start), "{}", output.stderr);
        assert!(output.stderr.contains(&end), "{}", output.stderr);

        let output = job.query("tables", &["select count(*) from phrases"]);
        // Reading is not refused, but nothing was ever committed.
        let expected = format!(
            "error: {url}: holds no store (it has no commits); check --store, or fill it with motiongen ingest\n"
        );
        assert_eq!((output.code, output.stderr), (2, expected));
    }
}

#[test]
fn throttling_without_end_ends_the_run_after_the_tries_that_were_asked_for() {
    let Some(job) = RemoteIngest::start(servers::gs(), "throttle") else { return };
    job.write_source(3, 0);
    let faults = Faults { too_many_requests_first: usize::MAX, ..Faults::default() };
    job.stores.inject(faults.only(|method, _| method == "PUT"));
    let output = finish(&mut job.ingest("tables", &["--max-retries", "1", "--workers", "1"]));
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{}", output.stderr);
    let start = format!("error: {}/beats/", job.url("tables"));
    assert!(output.stderr.starts_with(&start), "{}", output.stderr);
    for part in [".parquet: could not write: ", "429 Too Many Requests", "max_retries: 1"] {
        assert!(output.stderr.contains(part), "{part}: {}", output.stderr);
    }
    assert_eq!(job.stores.injected(), 2, "one try and one more");
}

#[test]
fn a_source_file_that_cannot_be_fetched_fails_its_phrase_alone() {
    let Some(job) = RemoteIngest::start(servers::gs(), "lone") else { return };
    job.write_source(7, 0);
    let one = |method: &str, path: &str| method == "GET" && path.ends_with("ü-004/trajectory.npy");
    job.stores.inject(Faults { deny: true, ..Faults::default() }.only(one));
    let output = finish(&mut job.ingest("tables", &[]));
    assert_eq!(output.code, 1, "{output:?}");
    let kinds = failure_kinds(&job.location("tables"));
    assert_eq!(kinds, [("set 1/ü-004".to_owned(), "unreadable".to_owned())].into());
    // Access granted, the next run heals it.
    job.stores.inject(Faults::default());
    let output = finish(&mut job.ingest("tables", &[]));
    assert_eq!(output.code, 0, "{output:?}");
    let store = job.location("tables");
    assert_eq!((rows_of(&store).len(), failure_kinds(&store).len()), (7, 0));
}

#[test]
fn a_cache_saves_every_download_of_a_second_ingest_but_those_of_changed_phrases() {
    let Some(job) = RemoteIngest::start(servers::gs(), "cache") else { return };
    job.write_source(19, 0);
    let folder = tempfile::tempdir().expect("a temporary folder");
    let cache = folder.path().join("cache").display().to_string();
    let flags = ["--cache", cache.as_str()];
    assert_eq!(finish(&mut job.ingest("one", &flags)).code, 0);
    let before = job.stores.requests().len();
    assert_eq!(finish(&mut job.ingest("two", &flags)).code, 0);
    assert_eq!(job.fetched(before), [""; 0]);
    job.contents("two").assert_same_as(&job.contents("one"));

    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let changed = "motion/set 2/ü-008/trajectory.npy";
    let path = object_store::path::Path::parse(format!("source/{changed}")).expect("a key");
    let (client, bytes) = (job.stores.client(&job.bucket), trajectory(&coherent(15, 99)));
    let put = object_store::ObjectStoreExt::put(&client, &path, bytes.into());
    runtime.expect("a runtime").block_on(put).expect("written");
    let before = job.stores.requests().len();
    assert_eq!(finish(&mut job.ingest("three", &flags)).code, 0);
    assert_eq!(job.fetched(before), [changed]);
}

#[test]
fn query_sums_the_splits_of_a_remote_store_exactly() {
    const SQL: &str = "select split, count(*) n, sum(duration_s) s from phrases group by split \
                       order by split";
    for (stores, n) in [(servers::gs(), 61), (servers::s3(), 47)] {
        let Some(job) = RemoteIngest::start(stores, "query") else { return };
        let source = job.write_source(n, 11);
        let output = finish(&mut job.ingest("tables", &["--batch-phrases", "10"]));
        assert_eq!(output.code, 1, "{output:?}");
        let mut sums: BTreeMap<&str, (usize, f64)> = BTreeMap::new();
        for (id, expected) in &source {
            let Ok(expected) = expected else { continue };
            let (n, s) = sums.entry(split_of(id)).or_default();
            (*n, *s) = (*n + 1, *s + expected.duration_s);
        }
        assert_eq!(sums.len(), 3, "phrases of every split are in the test: {sums:?}");
        let rows: String = sums.iter().map(|(k, (n, s))| format!("{k},{n},{s:?}\n")).collect();
        let output = job.query("tables", &["--format", "csv", SQL]);
        assert_eq!((output.code, output.stdout), (0, format!("split,n,s\n{rows}")));
        assert_eq!(output.stderr, "");
        // Throttled like everybody else, the query waits.
        job.stores.inject(Faults { too_many_requests_first: 1, ..Faults::default() });
        let output = job.query("tables", &["--format", "csv", SQL]);
        assert_eq!((output.code, output.stdout), (0, format!("split,n,s\n{rows}")));
        job.stores.inject(Faults::default());

        let mut table = String::from("┌────────────┬────┬──────┐\n");
        table += "│ split      ┆  n ┆    s │\n╞════════════╪════╪══════╡\n";
        for (split, (n, s)) in &sums {
            table += &format!("│ {split:<10} ┆ {n:>2} ┆ {s:>4} │\n");
        }
        table += "└────────────┴────┴──────┘\n";
        let output = job.query("tables", &[SQL]);
        assert_eq!((output.code, output.stdout), (0, table));
    }
}

#[test]
fn a_query_for_one_phrase_skips_the_parts_without_it() {
    let Some(job) = RemoteIngest::start(servers::gs(), "skip") else { return };
    job.write_source(41, 0);
    assert_eq!(finish(&mut job.ingest("tables", &["--batch-phrases", "5"])).code, 0);
    let before = job.stores.requests().len();
    let sql = "select frame, position_y from motion where phrase_id = 'set 1/ü-007' order by frame";
    let output = job.query("tables", &["--format", "csv", sql]);
    let frames = coherent(60, 7);
    let rows: Vec<&str> = output.stdout.lines().collect();
    assert_eq!((rows[0], rows.len()), ("frame,position_y", 61), "{output:?}");
    for (i, row) in rows[1..].iter().enumerate() {
        let (frame, value) = row.split_once(',').expect("two columns");
        assert_eq!((frame, value.parse()), (i.to_string().as_str(), Ok(frames[i][1])));
    }
    // `phrases` is not asked at all, and no part of `motion` is fetched whole.
    let asked: BTreeSet<_> = job.requests(before).into_iter().map(|(_, path)| path).collect();
    assert!(!asked.iter().any(|path| path.starts_with("tables/phrases/")), "{asked:?}");
    let requests = &job.stores.requests()[before..];
    let parts = requests.iter().filter(|r| r.method == "GET" && r.target.contains("parquet"));
    assert!(parts.clone().count() > 0 && parts.clone().all(|r| r.headers.get("range").is_some()));
}
