//! One broken phrase: how to make it, and what the table of failures must say of it.

use std::path::Path;

use crate::support::write;

pub struct Case {
    /// The phrase, as the table names it.
    pub id: String,
    pub kind: &'static str,
    /// The whole sentence; `{source}` stands for the source's folder.
    pub message: String,
    /// The file or folder at fault, below the source.
    pub at_fault: String,
    make: Make,
}

enum Make {
    Files(Vec<(String, Vec<u8>)>),
    With(fn(&Path)),
}

impl Case {
    /// A phrase of `motion/ID/trajectory.npy` alone.
    pub fn npy(id: &str, bytes: Vec<u8>, kind: &'static str, sentence: &str) -> Self {
        Self::file(id, &format!("motion/{id}/trajectory.npy"), bytes, kind, sentence)
    }

    /// A phrase of `motion/ID/motion.bvh` alone.
    pub fn bvh(id: &str, bytes: impl Into<Vec<u8>>, kind: &'static str, sentence: &str) -> Self {
        Self::file(id, &format!("motion/{id}/motion.bvh"), bytes, kind, sentence)
    }

    /// A phrase of `audio_features/ID/features.npz` alone.
    pub fn npz(id: &str, bytes: Vec<u8>, kind: &'static str, sentence: &str) -> Self {
        Self::file(id, &format!("audio_features/{id}/features.npz"), bytes, kind, sentence)
    }

    /// A phrase of one file; the message is `path: sentence` unless the sentence has a `{path}`.
    pub fn file(
        id: &str,
        path: &str,
        bytes: impl Into<Vec<u8>>,
        kind: &'static str,
        sentence: &str,
    ) -> Self {
        let start = if sentence.contains("{path}") { "" } else { "{path}: " };
        Self::files(id, [(path, bytes.into())], path, kind, &format!("{start}{sentence}"))
    }

    /// A phrase of several files; `{path}` in the message is the one at fault.
    pub fn files(
        id: &str,
        files: impl IntoIterator<Item = (impl Into<String>, Vec<u8>)>,
        at_fault: &str,
        kind: &'static str,
        message: &str,
    ) -> Self {
        let files = files.into_iter().map(|(path, bytes)| (path.into(), bytes)).collect();
        Self::new(id, Make::Files(files), at_fault, kind, message)
    }

    /// Something that takes more than writing files, made in the source's folder.
    pub fn tree(
        id: &str,
        at_fault: &str,
        make: fn(&Path),
        kind: &'static str,
        message: &str,
    ) -> Self {
        Self::new(id, Make::With(make), at_fault, kind, message)
    }

    fn new(id: &str, make: Make, at_fault: &str, kind: &'static str, message: &str) -> Self {
        let message = message.replace("{path}", at_fault);
        Self { id: id.to_owned(), kind, message, at_fault: at_fault.to_owned(), make }
    }

    /// Returns the size of the files that are written.
    pub fn n_bytes(&self) -> usize {
        match &self.make {
            Make::Files(files) => files.iter().map(|(_, bytes)| bytes.len()).sum(),
            Make::With(_) => 0,
        }
    }

    pub fn make(&self, source: &Path) {
        match &self.make {
            Make::Files(files) => {
                for (path, bytes) in files {
                    write(&source.join(path), bytes);
                }
            }
            Make::With(make) => make(source),
        }
    }
}
