//! Mixed groups, which a score learns to tell from real ones.

use std::collections::BTreeMap;

use crate::autodiff::Stream;

/// Who dances in mixed groups: for every group the group itself, and then its mixed ones.
///
/// Half of the mixed groups have members swapped: each dancer, with probability 1/2 and at least one, but not all, is
/// one of the group's partner, which dances to the same music at the same step of noise. In the first of these the
/// strangers are where the partner has them, and may be known by the formation and by bodies that touch; in the others
/// they dance in the places of those they replace, so that their steps alone tell. The other half are another group as
/// a whole.
///
/// Deviation: the published code (`mixed_intra_inter`) swaps members of any group of the batch where they are, with steps
/// of noise of their own, so that unequal steps, another tempo, another bar or touching bodies give mixed groups away; and
/// it may swap none or all. The paper adds noise to the mixed group and estimates it again (section 4.3), at eight times
/// the cost.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MixedGroups {
    /// Of every place in every group, the dancer who takes it: group · n_slots + place.
    pub dancers: Vec<usize>,
    /// Of every such dancer, the one in whose place on the floor it dances; itself where it stays.
    pub floor: Vec<usize>,
    /// Of every group, the group that it is held against.
    pub groups: Vec<usize>,
}

/// What has to be computed of mixed groups: each dancer and each group once.
///
/// The dancers who stay are those of the group itself, and of few other groups some are drawn more than once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DistinctGroups {
    /// Dancers that differ: who it is, in whose place on the floor, and the group that it is held against.
    pub dancers: Vec<DistinctDancer>,
    /// Of every place in each group that differs from those before it, the dancer.
    pub places: Vec<usize>,
    /// Of each such group, the one that it is held against.
    pub groups: Vec<usize>,
    /// Of every group and its mixed ones, the one that it is the same as.
    pub of_all: Vec<usize>,
}

/// A dancer of mixed groups; see [`MixedGroups`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct DistinctDancer {
    pub dancer: usize,
    pub floor: usize,
    pub group: usize,
}

impl MixedGroups {
    /// Tells what differs.
    pub fn distinct(&self) -> DistinctGroups {
        let n_slots = self.dancers.len() / self.groups.len().max(1);
        let (mut dancers, mut groups) = (BTreeMap::new(), BTreeMap::new());
        let mut found = DistinctGroups {
            dancers: Vec::new(),
            places: Vec::new(),
            groups: Vec::new(),
            of_all: Vec::with_capacity(self.groups.len()),
        };
        for (i, &group) in self.groups.iter().enumerate() {
            let places: Vec<usize> = (i * n_slots..(i + 1) * n_slots)
                .map(|at| {
                    let it =
                        DistinctDancer { dancer: self.dancers[at], floor: self.floor[at], group };
                    *dancers.entry(it).or_insert_with(|| {
                        found.dancers.push(it);
                        found.dancers.len() - 1
                    })
                })
                .collect();
            // The group is that of its dancers.
            let number = *groups.entry(places.clone()).or_insert_with(|| {
                found.places.extend(places);
                found.groups.push(group);
                found.groups.len() - 1
            });
            found.of_all.push(number);
        }
        found
    }
}

/// Mixes groups that have `n_dancers` dancers in the first of `n_slots` places; none where there is one group alone.
pub fn mixed(
    n_dancers: &[usize],
    n_slots: usize,
    n_negatives: usize,
    random: Stream,
) -> Option<MixedGroups> {
    let n_groups = n_dancers.len();
    if n_groups < 2 || n_negatives == 0 {
        return None;
    }
    // Of each mixed group one number for the other group, and three for each of its places.
    let width = 1 + 3 * n_slots;
    let mut numbers = vec![0.0_f64; n_groups * n_negatives * width];
    random.uniform(0, &mut numbers);
    let mut numbers = numbers.chunks_exact(width);
    let other = |group: usize, u: f64| {
        let i = (u * (n_groups - 1) as f64) as usize;
        if i < group { i } else { i + 1 }
    };
    // A group without a partner has members of any other.
    let partner = |group: usize, u: f64| match group ^ 1 {
        partner if partner < n_groups => partner,
        _ => other(group, u),
    };
    let mut found = MixedGroups { dancers: Vec::new(), floor: Vec::new(), groups: Vec::new() };
    for group in 0..n_groups {
        let own = |place: usize| group * n_slots + place;
        found.dancers.extend((0..n_slots).map(own));
        found.floor.extend((0..n_slots).map(own));
        found.groups.push(group);
        for k in 0..n_negatives {
            let drawn = numbers.next().expect("invariant: as many numbers as mixed groups");
            let whole = other(group, drawn[0]);
            let n_there = n_dancers[group];
            let swapped = swapped((0..n_there).map(|place| drawn[1 + 3 * place]).collect());
            for place in 0..n_slots {
                let u = &drawn[1 + 3 * place..][..3];
                let has_members_swapped = 2 * k < n_negatives;
                let dancer = if place >= n_there || has_members_swapped && !swapped[place] {
                    own(place)
                } else if has_members_swapped {
                    let from = partner(group, u[1]);
                    let n = n_dancers[from];
                    from * n_slots + ((u[2] * n as f64) as usize).min(n - 1)
                } else {
                    // Another group may have fewer dancers; then some of them dance twice.
                    whole * n_slots + place % n_dancers[whole]
                };
                found.dancers.push(dancer);
                let takes_place = has_members_swapped && k > 0;
                found.floor.push(if takes_place { own(place) } else { dancer });
            }
            found.groups.push(group);
        }
    }
    Some(found)
}

/// Returns which dancers of a group are swapped, by a number from 0 to 1 of each: those below 1/2, at least one, and not
/// all of several.
fn swapped(numbers: Vec<f64>) -> Vec<bool> {
    let mut swapped: Vec<bool> = numbers.iter().map(|&u| u < 0.5).collect();
    let place = |compare: fn(&f64, &f64) -> bool| {
        (1..numbers.len())
            .fold(0, |best, i| if compare(&numbers[i], &numbers[best]) { i } else { best })
    };
    if !swapped.contains(&true) {
        swapped[place(|a, b| a < b)] = true;
    } else if swapped.len() > 1 && !swapped.contains(&false) {
        swapped[place(|a, b| a > b)] = false;
    }
    swapped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_come_from_partners_whole_groups_from_others_and_absent_places_stay() {
        // Group 4 has no partner.
        let n_dancers = [3, 2, 4, 1, 3];
        let (n_slots, k) = (4, 8);
        let found = mixed(&n_dancers, n_slots, k, Stream::new(3, 1)).expect("five groups");
        assert_eq!(found.groups.len(), 5 * 9);
        for (i, (&dancer, &floor)) in found.dancers.iter().zip(&found.floor).enumerate() {
            let (place, group, kind) = (i % n_slots, i / n_slots / 9, i / n_slots % 9);
            let takes_place = (2..=4).contains(&kind);
            assert_eq!(floor, if takes_place { group * n_slots + place } else { dancer });
        }
        let (mut n_swapped, mut n_members) = (0, 0);
        for (i, (places, &group)) in found.dancers.chunks(n_slots).zip(&found.groups).enumerate() {
            assert_eq!(group, i / 9);
            let (there, absent) = places.split_at(n_dancers[group]);
            for (place, &dancer) in absent.iter().enumerate() {
                assert_eq!(dancer, group * n_slots + there.len() + place);
            }
            let sources: Vec<usize> = there.iter().map(|dancer| dancer / n_slots).collect();
            for (&dancer, &source) in there.iter().zip(&sources) {
                assert!(dancer % n_slots < n_dancers[source], "an absent dancer was taken");
            }
            let n_strangers = sources.iter().filter(|&&s| s != group).count();
            match i % 9 {
                0 => assert_eq!(n_strangers, 0),
                1..=4 => {
                    assert!(n_strangers >= 1);
                    assert!(n_strangers < sources.len() || sources.len() == 1, "none is left");
                    if group < 4 {
                        assert!(sources.iter().all(|&s| s == group || s == group ^ 1));
                    }
                    if sources.len() > 2 {
                        n_swapped += n_strangers;
                        n_members += sources.len();
                    }
                }
                _ => assert!(sources.iter().all(|&s| s == sources[0] && s != group)),
            }
        }
        let share = n_swapped as f64 / n_members as f64;
        // 40 members with p = 1/2: three deviations are 0.24.
        assert!((0.26..0.74).contains(&share), "{share}");
    }

    #[test]
    fn every_dancer_and_every_group_is_told_apart_once() {
        let (n_dancers, n_slots) = ([3, 2, 4, 1], 4);
        let all = mixed(&n_dancers, n_slots, 8, Stream::new(3, 1)).expect("four groups");
        let found = all.distinct();
        assert_eq!((found.groups.len() * n_slots, all.groups.len()), (found.places.len(), 36));
        for (i, &number) in found.of_all.iter().enumerate() {
            assert_eq!(found.groups[number], all.groups[i], "group {i}");
            for slot in 0..n_slots {
                let it = found.dancers[found.places[number * n_slots + slot]];
                let at = i * n_slots + slot;
                let wanted = (all.dancers[at], all.floor[at], all.groups[i]);
                assert_eq!((it.dancer, it.floor, it.group), wanted, "group {i}, place {slot}");
            }
        }
        let once = |n: usize, distinct: usize| assert_eq!(n, distinct, "something is there twice");
        let dancers: std::collections::BTreeSet<_> = found.dancers.iter().collect();
        once(found.dancers.len(), dancers.len());
        let groups: std::collections::BTreeSet<_> = found.places.chunks(n_slots).collect();
        once(found.groups.len(), groups.len());
        // Of three other groups four draws are not all different.
        assert!(found.groups.len() < 36 && found.dancers.len() < 36 * 3, "nothing was saved");
    }

    #[test]
    fn someone_is_swapped_and_someone_stays() {
        assert_eq!(swapped(vec![0.7, 0.6, 0.9]), [false, true, false]);
        assert_eq!(swapped(vec![0.1, 0.4, 0.3]), [true, false, true]);
        assert_eq!(swapped(vec![0.1, 0.8]), [true, false]);
        assert_eq!(swapped(vec![0.9]), [true]);
        assert_eq!(swapped(vec![0.2]), [true]);
    }

    #[test]
    fn a_group_alone_is_held_against_none() {
        assert_eq!(mixed(&[3], 3, 8, Stream::new(0, 0)), None);
        assert_eq!(mixed(&[3, 3], 3, 0, Stream::new(0, 0)), None);
    }
}
