//! What was asked of motions, as the table of generations keeps it.

use std::path::Path;

use motiongen::store::tables::GenerationRow;

use super::{generate, generations, modelled};
use crate::support::Dir;

#[test]
fn what_was_asked_is_kept_and_rows_of_version_4_have_nothing() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let text = "[start]\nposition_y = 0.5\n[[keyframe]]\nframe = 3\nposition_x = 0.25\n";
    let asked = dir.write("c.toml", text).display().to_string();
    generate(&store, &["--run=asked", "--constraints", &asked]);
    generate(&store, &["--run=free"]);
    let rows = generations(&store);
    for row in &rows {
        let wanted = r#"{"keyframe":[{"frame":0,"position_y":0.5},{"frame":3,"position_x":0.25}]}"#;
        assert_eq!(row.constraints.as_deref(), (row.run == "asked").then_some(wanted));
    }
    // What the column has is a file of constraints: the same motions are asked for by it.
    let text = rows.iter().find_map(|row| row.constraints.clone()).expect("constraints");
    let again = dir.write("again.json", text).display().to_string();
    generate(&store, &["--run=again", "--constraints", &again]);
    let found = generations(&store);
    let errors = |run: &str| -> Vec<_> {
        found.iter().filter(|row| row.run == run).map(|row| row.control_error_mm).collect()
    };
    assert_eq!(errors("again"), errors("asked"));

    as_version(&store, 4, &["constraints"]);
    let read = generations(&store);
    let without: Vec<GenerationRow> =
        found.into_iter().map(|row| GenerationRow { constraints: None, ..row }).collect();
    assert_eq!(read, without);
    let output = generate(&store, &["--run=asked", "--constraints", &asked]);
    assert!(output.stdout.contains("  nothing to do: 16 motions are up to date"), "{output:?}");
}

/// Writes the rows of generations as an older version has them, without some columns.
fn as_version(store: &Path, version: u32, without: &[&str]) {
    for entry in std::fs::read_dir(store.join("commits/generate")).expect("commits") {
        let path = entry.expect("an entry").path();
        let text = std::fs::read_to_string(&path).expect("a commit");
        let mut commit: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        for part in commit["parts"].as_array_mut().expect("parts") {
            if part["table"] != "generations" {
                continue;
            }
            part["schema_version"] = version.into();
            let path = store.join(part["path"].as_str().expect("a path"));
            let file = std::fs::File::open(&path).expect("the part");
            let reader =
                parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(file);
            let batches: Vec<_> = reader
                .expect("a part")
                .build()
                .expect("a reader")
                .collect::<Result<_, _>>()
                .expect("rows");
            let fields = batches[0].schema();
            let kept: Vec<usize> = (0..fields.fields().len())
                .filter(|&i| !without.contains(&fields.field(i).name().as_str()))
                .collect();
            let schema = std::sync::Arc::new(fields.project(&kept).expect("columns"));
            let file = std::fs::File::create(&path).expect("the part");
            let mut writer =
                parquet::arrow::ArrowWriter::try_new(file, schema, None).expect("made");
            for batch in batches {
                writer.write(&batch.project(&kept).expect("columns")).expect("written");
            }
            writer.close().expect("closed");
        }
        std::fs::write(&path, commit.to_string()).expect("written");
    }
}
