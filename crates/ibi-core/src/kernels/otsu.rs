//! Otsu's threshold (Otsu 1979).

/// The threshold that splits `values` (all >= 0) into two classes of the largest between-class variance,
/// searched over a histogram of `bins` bins from 0 to the maximum. `None` if the values are all equal, which
/// no threshold can split, or if there are none.
///
/// The threshold is the upper edge of the last bin of the lower class (the first one where several tie, as
/// they do across a gap of empty bins) and never below the smallest value.
#[must_use]
pub fn otsu(values: &[f32], bins: usize) -> Option<f32> {
    let max = values.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let min = values.iter().copied().fold(f32::INFINITY, f32::min);
    if values.is_empty() || min >= max {
        return None;
    }
    let mut histogram = vec![0_u32; bins];
    for &x in values {
        let bin = (f64::from(x) / f64::from(max) * bins as f64) as usize;
        histogram[bin.min(bins - 1)] += 1;
    }
    let total = values.len() as f64;
    let total_sum: f64 = histogram.iter().enumerate().map(|(b, &n)| b as f64 * f64::from(n)).sum();
    let (mut best, mut best_bin) = (-1.0, 0);
    let (mut weight, mut sum) = (0.0, 0.0);
    for (bin, &n) in histogram.iter().enumerate().take(bins - 1) {
        weight += f64::from(n);
        sum += bin as f64 * f64::from(n);
        if weight <= 0.0 || weight >= total {
            continue;
        }
        let gap = sum / weight - (total_sum - sum) / (total - weight);
        let variance = weight * (total - weight) * gap * gap;
        if variance > best {
            (best, best_bin) = (variance, bin);
        }
    }
    let edge = (f64::from(max) * (best_bin + 1) as f64 / bins as f64) as f32;
    // All values in one bin although they differ: split at the smallest instead.
    Some(if best < 0.0 { min } else { edge.max(min) })
}
