//! The three angles between a point and each of its neighbours, counted in bins.

/// Bins of an angle. Odd: the angles of flat ground fall into the middle of one.
pub(super) const SECTORS: usize = 11;

/// How many pairs are treated side by side.
const LANES: usize = 16;

/// cos and sin of pi/11, 3 pi/11 .. 9 pi/11: the edges of eleven equal sectors of the circle, above the axis.
const EDGES: [[f32; 2]; 5] = [
    [0.959_493, 0.281_732_56],
    [0.654_860_73, 0.755_749_6],
    [0.142_314_84, 0.989_821_43],
    [-0.415_415_01, 0.909_632],
    [-0.841_253_5, 0.540_640_8],
];

/// What is less is taken for 0, in units of the hypotenuse: whether two opposite walls are turned by +180 or -180
/// degrees is for rounding to say, and shall not depend on how the part lies.
const FLAT: f32 = 1e-6;

/// A point's neighbours as columns: where they lie from the point, in radii, and their normals.
#[derive(Default)]
pub(super) struct Pairs {
    columns: [Vec<f32>; 6],
    /// The three bins of each pair, four bits each.
    codes: Vec<u32>,
    len: usize,
}

impl Pairs {
    /// Makes room for so many neighbours.
    #[inline(always)]
    #[allow(clippy::inline_always)] // all of this belongs into one loop for the vector units
    pub(super) fn clear(&mut self, len: usize) {
        self.len = len;
        let padded = len.next_multiple_of(LANES);
        if self.codes.len() < padded {
            self.columns.iter_mut().for_each(|column| column.resize(padded, 0.0));
            self.codes.resize(padded, 0);
        }
    }

    /// Fills the columns: where each neighbour lies, and its normal.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    pub(super) fn fill(&mut self, neighbors: impl Iterator<Item = ([f32; 3], [f32; 3])>) {
        let len = self.len;
        let [dx, dy, dz, nx, ny, nz] = self.columns.each_mut().map(|column| &mut column[..len]);
        for (k, (d, n)) in (0..len).zip(neighbors) {
            (dx[k], dy[k], dz[k]) = d.into();
            (nx[k], ny[k], nz[k]) = n.into();
        }
    }

    /// How many pairs fall into each bin of each angle, for a point of that normal.
    #[inline(always)]
    #[allow(clippy::inline_always)]
    pub(super) fn count(&mut self, normal: [f32; 3]) -> [[u32; SECTORS]; 3] {
        // Whole vectors; what they hold beyond the end is left from points before and not looked at.
        let padded = self.len.next_multiple_of(LANES);
        encode(self.columns.each_ref().map(|c| &c[..padded]), normal, &mut self.codes[..padded]);
        // Two of each, or flat ground waits for the same count again and again. With 16 bins no index needs a check.
        let mut counts = [[[0_u32; 16]; 3]; 2];
        let codes = &self.codes[..self.len];
        for pair in codes.chunks(2) {
            for (counts, code) in counts.iter_mut().zip(pair) {
                for (angle, bins) in counts.iter_mut().enumerate() {
                    bins[(code >> (4 * angle)) as usize & 15] += 1;
                }
            }
        }
        std::array::from_fn(|a| std::array::from_fn(|bin| counts[0][a][bin] + counts[1][a][bin]))
    }
}

#[inline(always)]
#[allow(clippy::inline_always)]
fn encode(columns: [&[f32]; 6], normal: [f32; 3], codes: &mut [u32]) {
    let n = codes.len();
    let [dx, dy, dz, nx, ny, nz] = columns.map(|c| &c[..n]);
    for k in 0..n {
        codes[k] = code([dx[k], dy[k], dz[k]], normal, [nx[k], ny[k], nz[k]]);
    }
}

/// The bins of the angles between a point and its neighbour at `d`, of normals `n` and `m`.
///
/// The frame stands on that of the two whose normal leans more towards the other (Rusu et al. 2009, Eq. 1 and 2).
#[inline(always)]
#[allow(clippy::inline_always, clippy::needless_bitwise_bool)] // without branches
fn code(d: [f32; 3], n: [f32; 3], m: [f32; 3]) -> u32 {
    let length = dot(d, d).sqrt();
    let (along_n, along_m) = (dot(n, d), dot(m, d));
    let swap = along_n.abs() < along_m.abs();
    let pick = |a: f32, b: f32| if swap { b } else { a };
    let s = [pick(n[0], m[0]), pick(n[1], m[1]), pick(n[2], m[2])];
    let t = [pick(m[0], n[0]), pick(m[1], n[1]), pick(m[2], n[2])];
    let d = d.map(|x| pick(x, -x));
    let (along_s, along_t) = (pick(along_n, -along_m), pick(along_m, -along_n));
    // u = s, v = d x s, w = u x v, both as long as v.
    let v = [d[1] * s[2] - d[2] * s[1], d[2] * s[0] - d[0] * s[2], d[0] * s[1] - d[1] * s[0]];
    let width = dot(v, v).sqrt();
    let cos = dot(s, t);
    let (x, y) = (cos * width, along_t - along_s * cos);
    let y = if y.abs() <= FLAT * length { 0.0 } else { y };
    // atan2(y, x) is not needed, only between which edges it lies.
    let turns = EDGES.iter().map(|[cos, sin]| i32::from(y.abs() * cos >= x * sin)).sum::<i32>();
    let theta = 5 + if y < 0.0 { -turns } else { turns };
    let alpha = linear(dot(v, t) / width);
    let phi = linear(along_s / length);
    // Points at one place, or a line along the normal: no frame. Open3D counts them in the middle.
    let has_frame = (length > 0.0) & (width > 0.0);
    let code = theta as u32 | alpha << 4 | phi << 8;
    if has_frame { code } else { 0x555 }
}

/// The bin of a cosine.
#[inline(always)]
#[allow(clippy::inline_always)]
fn linear(cos: f32) -> u32 {
    ((cos * 5.5 + 5.5) as i32).clamp(0, 10) as u32
}

#[inline(always)]
#[allow(clippy::inline_always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use super::*;

    // More than 16 bits can count, as all that a huge radius holds may be.
    #[test]
    fn counts_very_many_neighbors() {
        let (count, mut pairs) = (200_001, Pairs::default());
        pairs.clear(count);
        pairs.fill((0..count).map(|k| ([1.0, k as f32 * 1e-9, 0.0], [0.0, 0.0, 1.0])));
        let counts = pairs.count([0.0, 0.0, 1.0]);
        assert_eq!(counts.map(|bins| bins.iter().sum::<u32>()), [count as u32; 3]);
        assert_eq!(counts[0][5], count as u32);
    }
}
