//! Parallel maps. The only file that names `rayon`.
//!
//! A map runs in parallel inside a [`Pool`] and serially outside one. rayon's global pool is never touched: a
//! process that forks after using it (Python's `multiprocessing` on Linux) hangs on the next use, where a pool of ours
//! sees that it has come into another process. Results are collected in order, so the number of threads never changes them.

use crate::error::Error;

/// A thread pool of our own, or, for one thread, none at all.
///
/// Its threads outlive it: the next pool of as many takes them over. New ones would start on the processor that
/// starts them, and until the system spreads them out, which takes it longer than a scene takes us, a second thread is of
/// little use.
#[derive(Debug)]
pub struct Pool {
    #[cfg(feature = "rayon")]
    threads: Option<idle::Threads>,
}

impl Pool {
    /// A pool of `num_threads`; `None` takes as many as the process may use. More than [`most_threads`] are not started: they
    /// would only stand in each other's way.
    ///
    /// # Errors
    /// [`Error::ThreadPool`] if the system refuses the threads.
    #[cfg(feature = "rayon")]
    pub fn new(num_threads: Option<usize>) -> Result<Self, Error> {
        let n = num_threads.unwrap_or_else(num_cores).clamp(1, most_threads());
        let threads = (n > 1).then(|| idle::take(n).map_or_else(|| idle::Threads::new(n), Ok)).transpose();
        Ok(Self { threads: threads.map_err(|e| Error::ThreadPool { reason: e.to_string() })? })
    }

    /// Without the feature `rayon` everything runs on the calling thread.
    ///
    /// # Errors
    /// None.
    #[cfg(not(feature = "rayon"))]
    pub fn new(_num_threads: Option<usize>) -> Result<Self, Error> {
        Ok(Self {})
    }

    /// How many threads it has.
    #[must_use]
    pub fn num_threads(&self) -> usize {
        #[cfg(feature = "rayon")]
        if let Some(threads) = &self.threads {
            return threads.pool.current_num_threads();
        }
        1
    }

    /// Runs `job`; the maps in it use this pool.
    pub fn install<T: Send>(&self, job: impl FnOnce() -> T + Send) -> T {
        #[cfg(feature = "rayon")]
        if let Some(threads) = &self.threads {
            return threads.pool.install(job);
        }
        job()
    }
}

/// Threads that the process may use.
fn num_cores() -> usize {
    std::thread::available_parallelism().map_or(1, Into::into)
}

/// Threads of a pool at most: four for each core that the process may use, but eight in any case.
#[must_use]
pub fn most_threads() -> usize {
    (4 * num_cores()).max(8)
}

#[cfg(feature = "rayon")]
impl Drop for Pool {
    fn drop(&mut self) {
        if let Some(threads) = self.threads.take() {
            idle::put(threads);
        }
    }
}

/// Threads that nobody uses at the moment. A pool is used by one at a time: a thread that waits takes up other work of its
/// pool, which must not be that of somebody else.
#[cfg(feature = "rayon")]
mod idle {
    use std::sync::Mutex;
    use std::{mem, process};

    use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};

    /// So many pools are kept: as many as are used at the same time, as a rule.
    const MOST: usize = 4;

    static IDLE: Mutex<Vec<Threads>> = Mutex::new(Vec::new());

    #[derive(Debug)]
    pub(super) struct Threads {
        pub(super) pool: ThreadPool,
        /// A process that forks takes its memory along, but not its threads.
        process: u32,
    }

    impl Threads {
        pub(super) fn new(num_threads: usize) -> Result<Self, ThreadPoolBuildError> {
            let pool = ThreadPoolBuilder::new().num_threads(num_threads).build()?;
            Ok(Self { pool, process: process::id() })
        }
    }

    /// Threads of this process, if there are as many idle ones. Here and below nobody waits for the lock: a thread that is
    /// no more may have held it when the process forked.
    pub(super) fn take(num_threads: usize) -> Option<Threads> {
        let mut idle = IDLE.try_lock().ok()?;
        let process = process::id();
        // Not dropped: that would be to tell threads that are not there.
        idle.extract_if(.., |threads| threads.process != process).for_each(mem::forget);
        let at = idle.iter().position(|threads| threads.pool.current_num_threads() == num_threads)?;
        Some(idle.remove(at))
    }

    /// Keeps threads for later, at the expense of the oldest. Not more than there are cores, which nobody asks for twice.
    pub(super) fn put(threads: Threads) {
        if threads.pool.current_num_threads() > super::num_cores().max(2) {
            return;
        }
        if let Ok(mut idle) = IDLE.try_lock() {
            idle.push(threads);
            if idle.len() > MOST {
                idle.remove(0);
            }
        }
    }
}

/// Whether work for `n` items, of which one thread should take no fewer than `grain`, is worth sharing.
#[cfg(feature = "rayon")]
fn share(n: usize, grain: usize) -> bool {
    n > grain && rayon::current_thread_index().is_some() && rayon::current_num_threads() > 1
}

/// Whether there is a second thread to share work with.
#[must_use]
pub fn is_parallel() -> bool {
    share(1, 0)
}

#[cfg(not(feature = "rayon"))]
fn share(_n: usize, _grain: usize) -> bool {
    false
}

/// Both results; in parallel where there is a second thread.
pub fn join<A: Send, B: Send>(a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    #[cfg(feature = "rayon")]
    if is_parallel() {
        return rayon::join(a, b);
    }
    (a(), b())
}

/// `(0..n).map(f)`, collected in order; threads take at least `grain` items at a time.
pub fn map<T: Send>(n: usize, grain: usize, f: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    #[cfg(feature = "rayon")]
    if share(n, grain) {
        use rayon::prelude::*;
        return (0..n).into_par_iter().with_min_len(grain.max(1)).map(f).collect();
    }
    let _ = grain;
    (0..n).map(f).collect()
}

/// What `f` makes of each chunk of `0..n`, in order. The chunks do not depend on the threads, and so neither do sums
/// over them.
pub fn chunks<T: Send>(
    n: usize,
    chunk: usize,
    f: impl Fn(std::ops::Range<usize>) -> T + Sync + Send,
) -> Vec<T> {
    map(n.div_ceil(chunk), 1, |c| f(c * chunk..n.min((c + 1) * chunk)))
}

/// Calls `f(row, slice)` for each row of a row-major matrix; threads take at least `grain` rows at a time.
pub fn for_rows<T: Send>(
    matrix: &mut [T],
    row_len: usize,
    grain: usize,
    f: impl Fn(usize, &mut [T]) + Sync + Send,
) {
    if row_len == 0 {
        return;
    }
    #[cfg(feature = "rayon")]
    if share(matrix.len() / row_len, grain) {
        use rayon::prelude::*;
        matrix
            .par_chunks_exact_mut(row_len)
            .with_min_len(grain.max(1))
            .enumerate()
            .for_each(|(i, row)| f(i, row));
        return;
    }
    let _ = grain;
    matrix.chunks_exact_mut(row_len).enumerate().for_each(|(i, row)| f(i, row));
}
