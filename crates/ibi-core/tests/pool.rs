//! The threads of pools. By itself, as other tests would take the idle ones.
#![cfg(feature = "rayon")]
#![allow(clippy::unwrap_used, reason = "tests may panic")]

use std::collections::HashSet;
use std::sync::Barrier;
use std::thread::{ThreadId, current};

use ibi_core::kernels::par::{self, Pool};

/// The two threads of a pool, each of which waits for the other.
fn threads_of(pool: &Pool) -> HashSet<ThreadId> {
    let both = Barrier::new(2);
    let id = || {
        both.wait();
        current().id()
    };
    let (a, b) = pool.install(|| par::join(id, id));
    [a, b].into()
}

#[test]
fn a_pool_takes_over_the_threads_of_one_that_is_gone_and_of_no_other() {
    let new = || Pool::new(Some(2)).unwrap();
    let (first, second) = (new(), new());
    let (of_first, of_second) = (threads_of(&first), threads_of(&second));
    assert_eq!(of_first.len(), 2);
    assert!(of_first.is_disjoint(&of_second));
    drop(first);
    let third = new();
    assert_eq!(threads_of(&third), of_first);
    assert_eq!(threads_of(&second), of_second);
    // Others are of another number, or belong to `second`.
    drop(third);
    assert!(Pool::new(Some(3)).unwrap().install(|| !of_first.contains(&current().id())));
    // One thread is no pool.
    let here = current().id();
    assert!(Pool::new(Some(1)).unwrap().install(|| current().id() == here));

    // Of many at once only some are kept.
    let many: Vec<Pool> = (0..10).map(|_| new()).collect();
    let all: HashSet<ThreadId> = many.iter().flat_map(threads_of).collect();
    assert_eq!(all.len(), 20);
    drop(many);
    let again: Vec<Pool> = (0..10).map(|_| new()).collect();
    let kept = again.iter().flat_map(threads_of).filter(|id| all.contains(id)).count();
    assert!((2..20).contains(&kept), "{kept}");
}
