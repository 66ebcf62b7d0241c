use super::*;
use crate::autodiff::chunk_range;

#[test]
fn values_and_numbers_of_all_come_by_rank() {
    for size in [1, 2, 5] {
        let found = together(size, |ranks| {
            let rank = ranks.rank();
            let numbers = ranks.share_numbers(&vec![0.1 * rank as f64; rank]).expect("all");
            let texts = ranks.share(&format!("rank {rank}")).expect("all");
            let first = ranks.of_first(&[f64::from_bits(7), rank as f64]).expect("all");
            (numbers, texts, first)
        });
        for (numbers, texts, first) in found {
            let wanted: Vec<Vec<f64>> =
                (0..size).map(|rank| vec![0.1 * rank as f64; rank]).collect();
            assert_eq!(numbers, wanted);
            assert_eq!(texts, (0..size).map(|rank| format!("rank {rank}")).collect::<Vec<_>>());
            assert_eq!(first.iter().map(|x| x.to_bits()).collect::<Vec<_>>(), [7, 0]);
        }
    }
}

#[test]
fn chunks_are_put_together_on_all_or_on_the_first() {
    let n = 2 * EXCHANGED_CHUNKS * SHARD_CHUNK + 3 * SHARD_CHUNK + 17;
    for size in [2, 3] {
        let found = together(size, |ranks| {
            let own = 1.0 + ranks.rank() as f32;
            let mut values = vec![own; n];
            ranks.collect(&mut values).expect("all");
            let collected = values.clone();
            values.fill(own);
            ranks.spread(&mut values).expect("all");
            (collected, values)
        });
        let is_by_owner = |values: &[f32]| {
            (0..n.div_ceil(SHARD_CHUNK)).all(|chunk| {
                let owner = 1.0 + (chunk % size) as f32;
                values[chunk_range(chunk, n)].iter().all(|&x| x == owner)
            })
        };
        for (rank, (collected, spread)) in found.iter().enumerate() {
            assert!(is_by_owner(spread), "rank {rank} of {size}");
            if rank == 0 {
                assert!(is_by_owner(collected), "rank {rank} of {size}");
            } else {
                assert!(collected.iter().all(|&x| x == 1.0 + rank as f32));
            }
        }
    }
}

#[test]
fn who_waits_for_a_process_that_is_gone_hears_of_it() {
    // The second leaves before the exchange of the first.
    let (to_first, from_second) = std::sync::mpsc::channel();
    let (to_second, from_first) = std::sync::mpsc::channel::<Message>();
    drop((to_first, from_first));
    let (to_self, from_self) = std::sync::mpsc::channel();
    let link = MemoryLink::of(0, vec![to_self, to_second], vec![from_self, from_second]);
    let ranks = Ranks::start(move || Ok(link)).expect("a thread");
    assert_eq!(ranks.share_numbers(&[1.0]), Err(RanksError::Gone));
    let not_started = Ranks::start(|| Err::<MemoryLink, _>(RanksError::NotStarted("x".to_owned())));
    assert_eq!(not_started.err(), Some(RanksError::NotStarted("x".to_owned())));
}
