//! Discrete replicator dynamics (Eq. 2; Rodola et al. 2013).

use super::columns::dot;
use super::par;

/// Shares below this are extinct. Left to decay, they would reach the subnormal floats, which are slow; with
/// payoffs of at least 1e-14 no product does.
const EXTINCT: f32 = 1e-20;

/// The population after exactly `steps` synchronous steps x_i <- x_i (Pi x)_i / x^T Pi x from the uniform
/// population 1/n. `payoff` is row-major n x n. `None` once x^T Pi x is 0: nobody supports anybody.
///
/// `interrupted` is asked before every step; the population as it is then comes back.
///
/// # Complexity
/// O(steps n^2).
pub fn replicator(
    payoff: &[f32],
    n: usize,
    steps: usize,
    interrupted: impl Fn() -> bool,
) -> Option<Vec<f32>> {
    let mut x = vec![1.0 / n as f32; n];
    for _ in 0..steps {
        if interrupted() {
            break;
        }
        let fitness = par::map(n, 64, |i| dot(&payoff[i * n..(i + 1) * n], &x));
        let mean: f64 = x.iter().zip(&fitness).map(|(&x, &f)| f64::from(x) * f64::from(f)).sum();
        if mean <= 0.0 {
            return None;
        }
        for (x, f) in x.iter_mut().zip(fitness) {
            let next = (f64::from(*x) * f64::from(f) / mean) as f32;
            *x = if next < EXTINCT { 0.0 } else { next };
        }
    }
    Some(x)
}
