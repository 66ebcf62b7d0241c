//! How an answer is shown: names of columns, long tables, null, streams.

use super::*;

#[test]
fn computed_columns_have_the_names_that_they_are_asked_by() {
    let (dir, _) = sound_store();
    let store = dir.at("store");
    assert_eq!(
        csv(&store, "select min(n_frames), max(n_frames), count(*) from phrases"),
        "min(n_frames),max(n_frames),count(*)\n17,59,5\n"
    );
    let sql = "select has_audio, count(*), max(n_frames) + 1, sum(n_frames) s from phrases \
               group by has_audio order by count(*) desc";
    let expected = "has_audio,count(*),max(n_frames) + 1,s\nfalse,3,60,129\ntrue,2,32,48\n";
    assert_eq!(csv(&store, sql), expected);
    let sql = "select lower(phrase_id), power(2, 10), sqrt(4) from phrases order by lower(phrase_id) limit 1";
    let expected = "lower(phrase_id),\"power(2, 10)\",sqrt(4)\n\"a/ü, \"\"quoted\"\"\",1024,2.0\n";
    assert_eq!(csv(&store, sql), expected);
    // A query that names one column twice is refused with the way out.
    let sql = "select phrase_id, n_frames as phrase_id from phrases";
    let expected = "two columns of the answer are called \"phrase_id\"; give one of them another name with \"as\"";
    assert_eq!(refusal(&store, sql), expected);
}

#[test]
fn long_tables_are_cut_and_say_so() {
    let (dir, _) = sound_store();
    let store = dir.at("store");
    let sql = "select phrase_id, frame from motion order by phrase_id, frame";
    let n_lines = |flags: &[&str]| {
        let output = ask(&store, &[flags, &[sql]].concat());
        assert_eq!((output.code, output.stderr.as_str()), (0, ""));
        let last = output.stdout.lines().last().unwrap_or_default().to_owned();
        (output.stdout.lines().count(), last)
    };
    let end = "└───────────────┴───────┘";
    let cut = |n: usize| format!("the first {n} rows of more; --limit 0 shows all");
    // A frame of four lines, and the rows.
    assert_eq!(n_lines(&[]), (4 + 40 + 1, cut(40)));
    assert_eq!(n_lines(&["--limit", "7"]), (4 + 7 + 1, cut(7)));
    assert_eq!(n_lines(&["--limit", "0"]), (4 + 177, end.to_owned()));
    assert_eq!(n_lines(&["--limit", "177"]), (4 + 177, end.to_owned()));
    // Data are whole unless they are asked not to be.
    assert_eq!(n_lines(&["--format", "csv"]).0, 1 + 177);
    assert_eq!(n_lines(&["--format", "csv", "--limit", "41"]).0, 1 + 41);
    let path = dir.at("a.json").display().to_string();
    let flags = ["--format", "json", "--limit", "3", "--output", &path, sql];
    assert_eq!(ask(&store, &flags).stdout, format!("3 rows → {path}\n"));
    let text = std::fs::read_to_string(&path).expect("an answer");
    let rows: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert_eq!(rows[2], serde_json::json!({"phrase_id": PHRASES[1].0, "frame": 2}));
    assert_eq!(rows.as_array().map(Vec::len), Some(3));
}

#[test]
fn null_is_not_an_empty_text() {
    let (dir, _) = sound_store();
    let sql =
        "select '' as nothing, tempo_source, tempo_bpm from phrases where phrase_id = 'gLO_3'";
    let output = ask(&dir.at("store"), &[sql]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("│         ┆ null         ┆      null │"), "{}", output.stdout);
}

#[test]
fn tables_and_columns_can_be_asked_for() {
    let (dir, _) = sound_store();
    let store = dir.at("store");
    let text = csv(&store, "show tables");
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some("name,n_rows,n_bytes,n_parts,schema_version"));
    assert!(lines.next().is_some_and(|line| line.starts_with("phrases,5,")), "{text}");
    assert!(lines.next().is_some_and(|line| line.starts_with("motion,177,")), "{text}");
    assert_eq!(lines.count(), 15);
    let text = csv(&store, "describe failures");
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some("name,type,nullable,unit,description"));
    assert!(lines.next().is_some_and(|line| line.starts_with("stage,utf8,false,\"\",")), "{text}");
    assert_eq!(lines.count(), 5);
    assert_eq!(csv(&store, "show columns from Failures"), text);
    assert_eq!(csv(&store, "desc failures;"), text);
}

/// Takes what is written until there is enough.
struct Until {
    n_left: usize,
    n_written: usize,
}

impl std::io::Write for Until {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.n_written += bytes.len();
        match self.n_left.checked_sub(bytes.len()) {
            Some(n_left) => {
                self.n_left = n_left;
                Ok(bytes.len())
            }
            None => Err(std::io::ErrorKind::BrokenPipe.into()),
        }
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[test]
fn rows_are_written_while_they_are_read() {
    let (dir, _) = sound_store();
    let store = Location::local(&dir.at("store")).expect("a location");
    let options = ClientOptions::default();
    // 177³ rows, of which few are read.
    let sql = "select a.frame, b.frame as b, c.position_x as c from motion a \
               cross join motion b cross join motion c";
    let formats = [
        (DataFormat::Csv, 3_000_000),
        (DataFormat::Json, 9_000_000),
        (DataFormat::Parquet, 90_000),
    ];
    for (format, n_left) in formats {
        let answer = query(&store, sql, &options).expect("a plan");
        let mut out = Until { n_left, n_written: 0 };
        let error = answer.write(format, &mut out).expect_err("the reader has gone");
        // The writer of Parquet wraps what its output says.
        let is_broken = error.kind() == std::io::ErrorKind::BrokenPipe
            || (format == DataFormat::Parquet && error.to_string().contains("broken pipe"));
        assert!(is_broken, "{format:?}: {error}");
        assert!(out.n_written > n_left / 3, "{format:?}: {}", out.n_written);
    }
    let answer = query(&store, "select frame from motion", &options).expect("a plan");
    let mut text = Vec::new();
    assert_eq!(answer.write(DataFormat::Csv, &mut text).expect("memory"), 177);
}
