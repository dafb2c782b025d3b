//! Parallel maps. The only file that names `rayon`.
//!
//! A map runs in parallel inside a [`Pool`] and serially outside one. rayon's global pool is never touched: a
//! process that forks after using it (Python's `multiprocessing` on Linux) hangs on the next use. Results are
//! collected in order, so the number of threads never changes them.

use crate::Error;

/// A thread pool of our own, or, for one thread, none at all.
#[derive(Debug)]
pub struct Pool {
    #[cfg(feature = "rayon")]
    pool: Option<rayon::ThreadPool>,
}

impl Pool {
    /// A pool of `num_threads`; `None` takes as many as the process may use.
    ///
    /// # Errors
    /// [`Error::ThreadPool`] if the system refuses the threads.
    #[cfg(feature = "rayon")]
    pub fn new(num_threads: Option<usize>) -> Result<Self, Error> {
        let n = num_threads
            .or_else(|| std::thread::available_parallelism().ok().map(Into::into))
            .unwrap_or(1)
            .max(1);
        let pool = (n > 1)
            .then(|| rayon::ThreadPoolBuilder::new().num_threads(n).build())
            .transpose()
            .map_err(|e| Error::ThreadPool { reason: e.to_string() })?;
        Ok(Self { pool })
    }

    /// Without the feature `rayon` everything runs on the calling thread.
    ///
    /// # Errors
    /// None.
    #[cfg(not(feature = "rayon"))]
    pub fn new(_num_threads: Option<usize>) -> Result<Self, Error> {
        Ok(Self {})
    }

    /// Runs `job`; the maps in it use this pool.
    pub fn install<T: Send>(&self, job: impl FnOnce() -> T + Send) -> T {
        #[cfg(feature = "rayon")]
        if let Some(pool) = &self.pool {
            return pool.install(job);
        }
        job()
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
