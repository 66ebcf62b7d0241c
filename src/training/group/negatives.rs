//! Mixed groups, which a score learns to tell from real ones.

use crate::autodiff::Stream;

/// Who dances in mixed groups: for every group the group itself, and then its mixed ones.
///
/// Half of the mixed groups have members swapped: each dancer, with probability 1/2, is one of another group of the
/// batch. The other half are another group as a whole (published code, `mixed_intra_inter`). Steps go with dancers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MixedGroups {
    /// Of every place in every group, the dancer who takes it: group · n_slots + place.
    pub dancers: Vec<usize>,
    /// Of every group, the group that it is held against.
    pub groups: Vec<usize>,
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
    let mut found = MixedGroups { dancers: Vec::new(), groups: Vec::new() };
    for group in 0..n_groups {
        let own = |place: usize| group * n_slots + place;
        found.dancers.extend((0..n_slots).map(own));
        found.groups.push(group);
        for k in 0..n_negatives {
            let drawn = numbers.next().expect("invariant: as many numbers as mixed groups");
            let whole = other(group, drawn[0]);
            for place in 0..n_slots {
                let u = &drawn[1 + 3 * place..][..3];
                let from = if 2 * k < n_negatives { other(group, u[1]) } else { whole };
                let is_taken = place < n_dancers[group] && (2 * k >= n_negatives || u[0] < 0.5);
                found.dancers.push(match is_taken {
                    false => own(place),
                    // Another group may have fewer dancers; then some of them dance twice.
                    true if 2 * k >= n_negatives => from * n_slots + place % n_dancers[from],
                    true => {
                        let n = n_dancers[from];
                        from * n_slots + ((u[2] * n as f64) as usize).min(n - 1)
                    }
                });
            }
            found.groups.push(group);
        }
    }
    Some(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_and_whole_groups_come_from_others_and_absent_places_stay() {
        let n_dancers = [3, 2, 4, 1, 3];
        let (n_slots, k) = (4, 8);
        let found = mixed(&n_dancers, n_slots, k, Stream::new(3, 1)).expect("five groups");
        assert_eq!(found.groups.len(), 5 * 9);
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
            match i % 9 {
                0 => assert!(sources.iter().all(|&s| s == group)),
                1..=4 => {
                    n_swapped += sources.iter().filter(|&&s| s != group).count();
                    n_members += sources.len();
                }
                _ => assert!(sources.iter().all(|&s| s == sources[0] && s != group)),
            }
        }
        let share = n_swapped as f64 / n_members as f64;
        // 52 members with p = 1/2: three deviations are 0.21.
        assert!((0.29..0.71).contains(&share), "{share}");
    }

    #[test]
    fn a_group_alone_is_held_against_none() {
        assert_eq!(mixed(&[3], 3, 8, Stream::new(0, 0)), None);
        assert_eq!(mixed(&[3, 3], 3, 0, Stream::new(0, 0)), None);
    }
}
