//! What manifests that no catalogue covers say: the last word of theirs on each item.

use std::collections::HashMap;

use crate::store::manifest::{Header, Manifest, Rank};

/// The latest settlement of each item in newer manifests.
pub(super) struct NewestItems<'a> {
    headers: Vec<Vec<Header>>,
    manifests: &'a [Manifest],
    /// Their manifests, and their places in those.
    pub of: HashMap<&'a str, (usize, usize)>,
    /// Items of each manifest whose rows are dead.
    pub dead: Vec<Vec<String>>,
}

impl<'a> NewestItems<'a> {
    pub fn of(manifests: &'a [Manifest]) -> Self {
        let headers = manifests.iter().map(Manifest::headers).collect();
        let dead = vec![Vec::new(); manifests.len()];
        let mut newest = Self { headers, manifests, of: HashMap::new(), dead };
        for (m, manifest) in manifests.iter().enumerate() {
            for (i, item) in manifest.items.iter().enumerate() {
                let Some(&known) = newest.of.get(item.id.as_str()) else {
                    newest.of.insert(&item.id, (m, i));
                    continue;
                };
                let is_later = newest.rank((m, i)) > newest.rank(known);
                if is_later {
                    newest.of.insert(&item.id, (m, i));
                }
                newest.dead[if is_later { known.0 } else { m }].push(item.id.clone());
            }
        }
        newest
    }

    pub fn header(&self, (m, i): (usize, usize)) -> &Header {
        &self.headers[m][self.manifests[m].header_of(i)]
    }

    pub fn rank(&self, place: (usize, usize)) -> Rank<'_> {
        let manifest = &self.manifests[place.0];
        Rank::new(self.header(place), manifest.generation(), &manifest.key)
    }
}
