//! What `diff-tables` says of two stores that differ in one place, and of two that do not.

mod compare;
mod digest;
mod table;

use std::path::Path;

use motiongen::store::tables::{self, PhraseRow};
use motiongen::store::{ClientOptions, Location, Row as _, TableSchema};

use crate::support::files::{coherent, trajectory};
use crate::support::{Dir, ingest};

use compare::Tolerances;
use digest::TableDigest;
use table::Table;

const N_FRAMES: usize = 31;

fn exact() -> Tolerances {
    Tolerances { usual: 0.0, named: Vec::new() }
}

/// Ingests five phrases, the one called `p2` with other frames by `shift` metres in height.
fn store(dir: &Dir, name: &str, shift: f32, batch: &str) -> std::path::PathBuf {
    let source = dir.at("source");
    for i in 0..5 {
        let mut frames = coherent(N_FRAMES, i);
        if i == 2 {
            frames.iter_mut().for_each(|frame| frame[1] += shift);
        }
        dir.write(format!("source/motion/p{i}/trajectory.npy"), trajectory(&frames));
    }
    let store = dir.at(name);
    let output = ingest(&source, &store, &["--force", batch]);
    assert_eq!(output.code, 0, "{output:?}");
    store
}

fn read(store: &Path, schema: &TableSchema) -> Table {
    let store = Location::open(&store.display().to_string(), &ClientOptions::default());
    Table::read(&store.expect("a store"), schema).expect("a table")
}

fn both(a: &Path, b: &Path, schema: &TableSchema, tolerances: &Tolerances) -> [Vec<String>; 2] {
    let (a, b) = (read(a, schema), read(b, schema));
    let (of_a, of_b) = (TableDigest::of(&a), TableDigest::of(&b));
    [
        compare::tables(schema.name, &a, &b, tolerances),
        compare::digests(schema.name, &of_a, &of_b, tolerances),
    ]
}

#[test]
fn stores_of_the_same_rows_do_not_differ_whatever_parts_they_lie_in() {
    let dir = Dir::new();
    let (a, b) =
        (store(&dir, "a", 0.0, "--batch-phrases=512"), store(&dir, "b", 0.0, "--batch-phrases=1"));
    for schema in [PhraseRow::schema(), tables::motion()] {
        assert_eq!(both(&a, &b, &schema, &exact()), [Vec::<String>::new(), Vec::new()]);
    }
    assert_eq!(read(&a, &tables::motion()).n_rows, 5 * N_FRAMES);
}

#[test]
fn one_value_that_differs_is_named_with_its_place_and_size() {
    let dir = Dir::new();
    let a = store(&dir, "a", 0.0, "--batch-phrases=512");
    let b = store(&dir, "b", 0.25, "--batch-phrases=512");
    let [rows, digests] = both(&a, &b, &tables::motion(), &exact());
    let [difference] = &rows[..] else { panic!("{rows:?}") };
    let expected =
        format!("motion.position_y: {N_FRAMES} of {} rows, by up to 2.500e-1", 5 * N_FRAMES);
    assert!(difference.starts_with(&expected), "{difference}");
    // Phrase p2 is the third of five.
    let row: usize = difference
        .split("in row ")
        .nth(1)
        .and_then(|rest| rest.split(' ').next())
        .and_then(|number| number.parse().ok())
        .expect("a row");
    assert!((2 * N_FRAMES..3 * N_FRAMES).contains(&row), "{difference}");
    assert_eq!(digests.len(), 1, "{digests:?}");
    assert!(digests[0].starts_with("motion.position_y: "), "{digests:?}");

    let wide = Tolerances { usual: 0.0, named: vec![("motion.position_y".into(), 10.0)] };
    assert_eq!(both(&a, &b, &tables::motion(), &wide), [Vec::<String>::new(), Vec::new()]);
    let left_out =
        Tolerances { usual: 0.0, named: vec![("phrases.content_hash".into(), f64::INFINITY)] };
    assert_eq!(both(&a, &b, &PhraseRow::schema(), &left_out), [Vec::<String>::new(), Vec::new()]);
    let elsewhere = Tolerances { usual: 0.0, named: vec![("motion.position_x".into(), 10.0)] };
    assert_eq!(both(&a, &b, &tables::motion(), &elsewhere)[0].len(), 1);

    let [rows, digests] = both(&a, &b, &PhraseRow::schema(), &exact());
    let first = "phrases.content_hash: first in row 2: ";
    assert!(rows.len() == 1 && rows[0].starts_with(first), "{rows:?}");
    assert!(digests.len() == 1 && digests[0].starts_with("phrases.content_hash: other text"));
}

#[test]
fn rows_that_change_places_and_columns_that_come_and_go_are_told() {
    use table::Values;
    let numbers = |x: [f64; 3]| Values::Numbers(x.map(Some).to_vec());
    let table = |columns: Vec<(String, Values)>| Table { n_rows: 3, columns };
    let a = table(vec![("x".into(), numbers([1.0, 2.0, 4.0]))]);
    let swapped = table(vec![("x".into(), numbers([2.0, 1.0, 4.0]))]);
    let told = compare::digests(
        "t",
        &TableDigest::of(&a),
        &TableDigest::of(&swapped),
        &Tolerances { usual: 1e-3, named: Vec::new() },
    );
    assert_eq!(told.len(), 1, "the mean is the same, the order is not: {told:?}");
    let other = table(vec![("y".into(), numbers([1.0, 2.0, 4.0]))]);
    let told = compare::tables("t", &a, &other, &exact());
    assert_eq!(told, ["t.x: is there no more", "t.y: is new"]);
    let fewer = Table { n_rows: 2, columns: Vec::new() };
    assert_eq!(compare::tables("t", &a, &fewer, &exact()), ["t: 3 rows, then 2"]);
    let null = table(vec![("x".into(), Values::Numbers(vec![Some(1.0), None, Some(4.0)]))]);
    assert_eq!(compare::tables("t", &a, &null, &exact()).len(), 1);
    let signed = |x: f64| table(vec![("x".into(), numbers([1.0, x, 4.0]))]);
    let told = compare::tables("t", &signed(0.0), &signed(-0.0), &exact());
    assert_eq!(told.len(), 1, "to the last bit: {told:?}");
    let near = Tolerances { usual: 1e-12, named: Vec::new() };
    assert_eq!(compare::tables("t", &signed(0.0), &signed(-0.0), &near).len(), 0);
    let text = |x: [Option<&str>; 3]| {
        table(vec![("s".into(), Values::Texts(x.map(|x| x.map(str::to_owned)).to_vec()))])
    };
    let (empty, nothing) = (text([Some(""), Some("a"), None]), text([None, Some("a"), Some("")]));
    let told =
        compare::digests("t", &TableDigest::of(&empty), &TableDigest::of(&nothing), &exact());
    assert_eq!(told.len(), 1, "null is not the empty text: {told:?}");
}
