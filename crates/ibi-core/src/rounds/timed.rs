//! How long a job takes.

use std::time::Instant;

/// Runs `job` and adds its seconds to `total_s`.
pub(super) fn timed<T>(total_s: &mut f64, job: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = job();
    *total_s += start.elapsed().as_secs_f64();
    result
}
