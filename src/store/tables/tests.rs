use super::*;

#[test]
fn rows_survive_the_way_through_a_batch() {
    let rows = vec![
        FailureRow {
            stage: "ingest".into(),
            phrase_id: "a b/ü".into(),
            source: "file:///x".into(),
            kind: "shape".into(),
            message: "m".into(),
            time: TimestampUs(1_700_000_000_123_456),
        },
        FailureRow {
            stage: "ingest".into(),
            phrase_id: "c".into(),
            source: String::new(),
            kind: String::new(),
            message: String::new(),
            time: TimestampUs(-1),
        },
    ];
    assert_eq!(FailureRow::from_batch(&FailureRow::to_batch(&rows)), Some(rows));
}

#[test]
fn a_batch_of_another_table_is_no_row() {
    let row = FailureRow {
        stage: "ingest".into(),
        phrase_id: "a".into(),
        source: String::new(),
        kind: String::new(),
        message: String::new(),
        time: TimestampUs(0),
    };
    assert_eq!(PhraseRow::from_batch(&FailureRow::to_batch(&[row])), None);
}

#[test]
fn column_names_are_unique_and_sort_columns_exist() {
    for table in all() {
        let mut names: Vec<_> = table.columns.iter().map(|c| c.name.as_ref()).collect();
        for sort in table.sorted_by {
            assert!(names.contains(sort), "{}: {sort}", table.name);
        }
        let item = table.columns.iter().find(|c| c.name == table.item_column());
        assert_eq!(item.map(|c| c.column_type), Some(ColumnType::Utf8), "{}", table.name);
        let n = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), n, "{}", table.name);
    }
}
