//! What is not answered, and what is said instead.

use super::*;

#[test]
fn a_place_without_a_store_is_an_error() {
    let dir = Dir::new();
    let (nowhere, folder) = (dir.at("typo"), dir.write("folder/notes.txt", "x"));
    let file = dir.write("a file", "x");
    for place in [nowhere.as_path(), folder.parent().expect("a folder"), &file] {
        let place_shown = place.canonicalize().unwrap_or_else(|_| place.to_owned());
        let expected = format!(
            "{}: holds no store (it has no commits); check --store, or fill it with motiongen ingest",
            place_shown.display()
        );
        for sql in ["select count(*) from phrases", "show tables"] {
            assert_eq!(refusal(place, sql), expected);
        }
        assert_eq!(refusal(place, "--tables"), expected);
        assert_eq!(refusal(place, "describe phrases"), expected);
    }
    assert!(!nowhere.exists(), "asking created the store");
}

/// Returns "table NAME has COLUMN, …" of a table.
fn columns_of(schema: &TableSchema) -> String {
    let names: Vec<_> = schema.columns.iter().map(|c| c.name.as_ref()).collect();
    format!("table {} has {}", schema.name, names.join(", "))
}

#[test]
fn an_unknown_column_comes_with_the_nearest_ones() {
    let (dir, _) = sound_store();
    let store = dir.at("store");
    let of_phrases = columns_of(&PhraseRow::schema());
    let tempo = format!(
        "column \"tempo_bmp\" not found; nearest: tempo_bpm, tempo_source, motion_up; {of_phrases}"
    );
    let wherever = [
        "select tempo_bmp from phrases",
        "select phrase_id from phrases where tempo_bmp > 100",
        "select p.tempo_bmp from phrases p",
        "select phrases.tempo_bmp from phrases",
        "select split, avg(tempo_bmp) from phrases group by split",
        "select phrase_id from phrases order by tempo_bmp",
    ];
    for sql in wherever {
        assert_eq!(refusal(&store, sql), tempo, "{sql}");
    }
    let sql = "select m.phrase from motion m join phrases p on m.phrase_id = p.phrase_id";
    let sentence = refusal(&store, sql);
    let start = "column \"phrase\" not found; nearest: phase, phrase_id, has_beats; ";
    assert!(sentence.starts_with(start), "{sentence}");
    let end = format!("{of_phrases}; {}", columns_of(&motion()));
    assert!(sentence.ends_with(&end), "{sentence}");
}

#[test]
fn an_unknown_table_comes_with_the_nearest_and_all_others() {
    let dir = Dir::new();
    empty_store(&dir);
    for (sql, table, nearest) in [
        ("select * from phrase", "phrase", "phrases, beats, failures"),
        ("select * from phrases join motions using (phrase_id)", "motions", "motion"),
        ("select count(*) from failure", "failure", "failures"),
        ("describe phrase", "phrase", "phrases"),
    ] {
        let sentence = refusal(&dir.at("store"), sql);
        let start = format!("table \"{table}\" not found; nearest: {nearest}");
        assert!(sentence.starts_with(&start), "{sentence}");
        let all = "; a store has phrases, motion, features, extractions, beats, failures, \
                   training_log, onnx_checks, generations, generated, decoded, tokens, tokenizations, \
                   sanity_checks, metrics, verdicts, song_metrics";
        assert!(sentence.ends_with(all), "{sentence}");
    }
}

#[test]
fn broken_sql_is_refused_in_one_useful_line() {
    let dir = Dir::new();
    empty_store(&dir);
    for (sql, part) in [
        ("selct phrase_id from phrases", "selct"),
        ("select phrase_id from phrases where", "Expected"),
        ("select (1 from phrases", "Expected"),
        ("select nosuchfunction(phrase_id) from phrases", "nosuchfunction"),
        ("", "the statement is empty; ask for example"),
        ("select 1; select 2", "there are several statements; ask them one after the other"),
        (
            "select m.frame from motion m left join phrases p on p.phrase_id = m.phrase_id and \
             p.split = 'train'",
            "column \"split\" cannot be asked for at this place; a join compares a column of one table \
             with one of the other, and all else belongs into \"where\" or into a sub-select",
        ),
        (
            "select phrase_id from phrases where exists (select 1 from motion)",
            "\"exists\" is not in this SQL; docs/query.md has what is",
        ),
        ("select avg(split) from phrases", "`mean` operation not supported for dtype `str`"),
    ] {
        let sentence = refusal(&dir.at("store"), sql);
        assert!(sentence.contains(part), "{sql}: {sentence}");
    }
}

#[test]
fn a_statement_that_would_change_a_table_is_refused() {
    let (dir, _) = sound_store();
    for (sql, verb) in [
        ("delete from phrases", "delete"),
        (" DROP table phrases", "drop"),
        ("create table x as select * from phrases", "create"),
        ("/* x */ drop table phrases", "drop"),
        (" -- x\ntruncate phrases", "truncate"),
        ("copy phrases to 'x'", "copy"),
        ("merge into phrases using beats on true", "merge"),
    ] {
        let expected = format!(
            "\"{verb}\" is not answered: tables are read here, and changed by stages alone; begin with \
             \"select\", \"show tables\" or \"describe\""
        );
        assert_eq!(refusal(&dir.at("store"), sql), expected);
    }
    assert_eq!(csv(&dir.at("store"), "select count(*) n from phrases"), "n\n5\n");
}

#[test]
fn a_query_without_sql_or_with_an_unknown_format_is_refused() {
    let dir = Dir::new();
    let output = ask(&dir.at("store"), &[]);
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{output:?}");
    assert!(output.stderr.contains("<SQL>"), "{}", output.stderr);
    let output = ask(&dir.at("store"), &["--format", "xml", SOME]);
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{output:?}");
    assert!(output.stderr.contains("use table, csv, json or parquet"), "{}", output.stderr);
    let output = ask(&dir.at("store"), &["--tables", SOME]);
    assert_eq!(output.code, 2, "{output:?}");
}

#[test]
fn a_part_of_another_schema_version_is_refused_with_what_to_do() {
    for (version, remedy) in
        [(3, "install a newer motiongen"), (0, "run the stage that wrote it again with --force")]
    {
        let dir = Dir::new();
        let store = Location::local(&dir.at("store")).expect("a location");
        let mut commit = Commit::new(&store, "ingest", "rules", "file:///source");
        let part = commit.part("motion", || TableSchema { version, ..motion() }).expect("a file");
        part.write_frames("a", Array2::zeros((3, 25)).view()).expect("frames");
        let (fingerprint, input_hash) = (String::new(), String::new());
        let item = Item { id: "a".to_owned(), fingerprint, input_hash, failure: None };
        commit.settle(item, &Ledger::default());
        commit.publish().expect("published");
        let part = store.list("motion").expect("a listing").remove(0).path;
        let expected = format!(
            "table motion: {} has schema version {version}, this program reads versions 1 to 2; \
             {remedy}",
            store.url_of(&part)
        );
        assert_eq!(refusal(&dir.at("store"), "select count(*) from motion"), expected);
        assert_eq!(csv(&dir.at("store"), "select count(*) n from phrases"), "n\n0\n");
    }
}
