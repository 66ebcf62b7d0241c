//! The files of phrases, read ahead in the order of work.

use std::collections::{BTreeMap, HashMap};

use super::PhraseTask;
use crate::store::{ClientOptions, Content, OrderedContents, Source, SourceFile, StoreError};

/// The files of the tasks, read in the tasks' order.
pub struct PhraseInputs {
    /// `None` for a source that cannot be opened.
    sources: HashMap<String, Option<(Source, OrderedContents)>>,
    options: ClientOptions,
}

/// The file of a task and what was read of it.
pub struct PhraseInput {
    pub file: SourceFile,
    pub content: Result<Content, StoreError>,
    /// The read-ahead budget of the file, given back when the phrase is done.
    pub permit: Option<Box<dyn Send>>,
}

impl PhraseInputs {
    pub fn open(tasks: &[PhraseTask], options: &ClientOptions) -> Self {
        let mut files: BTreeMap<&str, Vec<&PhraseTask>> = BTreeMap::new();
        for task in tasks {
            files.entry(&task.row.source).or_default().push(task);
        }
        let open = |url: &str, tasks: Vec<&PhraseTask>| {
            // What is read is held against the digest that ingest recorded, wherever it lies.
            let source = Source::open(url, options, None).ok()?.following_links(true);
            let wanted = tasks.iter().filter_map(|task| Self::file(&source, task)).collect();
            let reader = source.read_in_order(wanted);
            Some((source, reader))
        };
        let sources = files.into_iter().map(|(url, tasks)| (url.to_owned(), open(url, tasks)));
        Self { sources: sources.collect(), options: options.clone() }
    }

    /// Returns why a task has no input.
    fn error(&self, task: &PhraseTask) -> StoreError {
        let source = Source::open(&task.row.source, &self.options, None);
        source.err().unwrap_or_else(|| StoreError::NotFound { place: task.url.clone(), hint: "" })
    }

    fn file(source: &Source, task: &PhraseTask) -> Option<SourceFile> {
        source.recorded(&task.url, task.size_bytes, &task.row.content_hash)
    }

    pub fn next(&mut self, task: &PhraseTask) -> PhraseInput {
        let unknown = SourceFile {
            path: task.url.clone(),
            size_bytes: task.size_bytes,
            fingerprint: String::new(),
        };
        let found = match self.sources.get_mut(&task.row.source) {
            Some(Some((source, reader))) => {
                Self::file(source, task).and_then(|file| Some((file, reader.next()?)))
            }
            Some(None) | None => None,
        };
        match found {
            Some((file, (content, permit))) => {
                let permit = permit.map(|permit| Box::new(permit) as Box<dyn Send>);
                PhraseInput { file, content, permit }
            }
            None => PhraseInput { file: unknown, content: Err(self.error(task)), permit: None },
        }
    }
}
