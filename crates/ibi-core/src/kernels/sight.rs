//! What a depth camera can see of a model, and what it has seen of the scene.

use std::collections::HashMap;
use std::f64::consts::PI;
use std::sync::OnceLock;

use nalgebra::{Isometry3, Point3, Unit, Vector3};

use super::columns::middle;
use super::grid::buckets;
use super::par;
use crate::interrupt::{Interrupt, Phase};
use crate::pace::Pace;

/// One of `count` directions that are evenly spread (the spiral of the golden angle, Vogel 1979).
pub(crate) fn direction(index: usize, count: usize) -> Vector3<f64> {
    let golden = PI * (3.0 - 5.0_f64.sqrt());
    let z = 1.0 - (2 * index + 1) as f64 / count as f64;
    let (sin, cos) = (golden * index as f64).sin_cos();
    let r = (1.0 - z * z).sqrt();
    Vector3::new(r * cos, r * sin, z)
}

/// Two directions across `forward`, right-handed with it.
pub(crate) fn across(forward: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let aside = Vector3::ith(forward.iamin(), 1.0);
    let right = forward.cross(&aside).normalize();
    [right, forward.cross(&right)]
}

/// A camera.
#[derive(Debug)]
pub struct Eye {
    /// Where it stands, in the frame of the target.
    pub place: Point3<f64>,
    /// What it measured.
    pub measured: Option<RangeImage>,
}

impl Eye {
    /// A camera of which nothing is known but its place.
    #[must_use]
    pub fn at(place: Point3<f64>) -> Self {
        Self { place, measured: None }
    }
}

/// What is known of how a scene was seen.
#[derive(Debug, Clone, Copy)]
pub struct View<'a> {
    /// By these cameras: a point is seen if one of them sees it.
    pub eyes: &'a [Eye],
    /// Which source points the source itself hides.
    pub own: Option<&'a OwnShadow>,
}

/// All of so many eyes are asked of a pose.
pub(crate) const FEW_EYES: usize = 4;

/// Those of `eyes`, which are `at` places, that are asked of what lies around a place: all, or of more than [`FEW_EYES`] so many as `of_many`, the nearest first,
/// and then, each time, the one that looks from farthest beside those.
#[must_use]
pub(crate) fn asked<'a, E>(
    eyes: &'a [E],
    at: impl Fn(&'a E) -> &'a Point3<f64>,
    place: &Point3<f64>,
    of_many: usize,
) -> Vec<&'a E> {
    if eyes.len() <= FEW_EYES {
        return eyes.iter().collect();
    }
    let ways: Vec<Vector3<f64>> = eyes.iter().map(|eye| at(eye) - place).collect();
    let nearest = (0..eyes.len()).min_by(|&a, &b| ways[a].norm_squared().total_cmp(&ways[b].norm_squared()));
    let directions: Vec<_> = ways.iter().map(|way| way.try_normalize(0.0).unwrap_or_default()).collect();
    let far = |a: usize, b: usize| (directions[a] - directions[b]).norm_squared();
    spread(nearest.unwrap_or(0), of_many, eyes.len(), far).into_iter().map(|row| &eyes[row]).collect()
}

/// `most` of `count` things, or all: the `first`, and then, each time, the one that is farthest from all before it.
pub(crate) fn spread(
    first: usize,
    most: usize,
    count: usize,
    far: impl Fn(usize, usize) -> f64,
) -> Vec<usize> {
    let mut picked = vec![first];
    let mut gap: Vec<f64> = (0..count).map(|i| far(i, first)).collect();
    while picked.len() < most.min(count) {
        let next = (0..count).max_by(|&a, &b| gap[a].total_cmp(&gap[b]).then(b.cmp(&a))).unwrap_or(first);
        gap.iter_mut().enumerate().for_each(|(i, gap)| *gap = gap.min(far(i, next)));
        picked.push(next);
    }
    picked
}

/// Directions in which shadows are known: neighbours are about 20 degrees apart.
const DIRECTIONS: usize = 128;

/// Of points on a surface, how far aside of a line of sight one still hides those behind it, how far before them it
/// must be (both in spacings), and the least share of that distance by which it rises above their tangent plane: what
/// goes on in the plane of a slanted surface hides nothing. Held against rays cast at meshes this errs most where walls
/// are as thin as the spacing.
const ASIDE: f64 = 0.9;
const BEFORE: f64 = 1.0;
const RISE: f64 = 0.25;

/// A cell with more points than so many is crowded.
const CROWDED: u32 = 64;

/// Cells on a side at most.
const MAX_CELLS: f64 = 1024.0;

/// Of a larger cloud the shadows of so many points are worked out, at most: each of the others takes the answer of one in
/// its voxel whose normal lies in the same octant, so that no point answers for the other side of a wall.
const MOST: usize = 50_000;

/// How much wider voxels become if too many are left, and how wide they are at first: so many spacings, if the points
/// were few enough. On a surface they then hold a few each.
const WIDEN: f64 = 1.25;
const FIRST_WIDTH: f64 = 2.0;

/// Which points of a surface the surface itself hides, as seen from far away in one of 128 directions.
#[derive(Debug)]
pub struct OwnShadow {
    middle: Point3<f64>,
    directions: Vec<Vector3<f64>>,
    /// For each direction, for each point; of a large cloud for each of those that answer for others.
    is_hidden: Vec<Vec<bool>>,
    of_all: Option<OfAll>,
}

/// The answers for all points of a large cloud.
#[derive(Debug)]
struct OfAll {
    /// Which of the answers is that of each point.
    answer: Vec<u32>,
    /// For each direction, once it is asked for, for each point.
    is_hidden: Vec<OnceLock<Vec<bool>>>,
}

impl OwnShadow {
    /// Of points with outward unit normals and their mean spacing.
    ///
    /// # Complexity
    /// O(points) for each direction; no more than for 50,000 points, and O(points) beside it.
    #[must_use]
    pub fn new(points: &[Point3<f64>], normals: &[Vector3<f64>], spacing: f64) -> Self {
        let nothing =
            || Self { middle: Point3::origin(), directions: Vec::new(), is_hidden: Vec::new(), of_all: None };
        Self::until(points, normals, spacing, &Interrupt::never()).unwrap_or_else(nothing)
    }

    /// The same; `None` if interrupted.
    #[must_use]
    pub fn until(
        points: &[Point3<f64>],
        normals: &[Vector3<f64>],
        spacing: f64,
        interrupt: &Interrupt,
    ) -> Option<Self> {
        if !interrupt.enter(Phase::Shadow) {
            return None;
        }
        let directions: Vec<_> = (0..DIRECTIONS).map(|i| direction(i, DIRECTIONS)).collect();
        let (mut some, mut of_all) = (None, None);
        if points.len() > MOST {
            let (rows, answer, width) = few(points, normals, spacing, interrupt)?;
            let kept: Vec<_> = rows.iter().map(|&row| points[row as usize]).collect();
            // Not measured: what is nearest may lie on the other side of a wall.
            let spacing = spacing.max(width);
            some = Some((kept, rows.iter().map(|&row| normals[row as usize]).collect::<Vec<_>>(), spacing));
            of_all = Some(OfAll { answer, is_hidden: (0..DIRECTIONS).map(|_| OnceLock::new()).collect() });
        }
        let (kept, of_kept, spacing) =
            some.as_ref().map_or((points, normals, spacing), |(p, n, s)| (p, n, *s));
        let is_hidden =
            par::map(DIRECTIONS, 1, |i| hidden(kept, of_kept, spacing, &directions[i], interrupt));
        let shadow = Self { middle: middle(points).into(), directions, is_hidden, of_all };
        (!interrupt.is_set()).then_some(shadow)
    }

    /// The shadow on some of the points.
    #[must_use]
    pub fn on(&self, rows: &[u32]) -> Self {
        let answer = |&row: &u32| self.of_all.as_ref().map_or(row, |of_all| of_all.answer[row as usize]);
        let pick = |all: &Vec<bool>| rows.iter().map(|row| all[answer(row) as usize]).collect();
        let is_hidden = self.is_hidden.iter().map(pick).collect();
        Self { middle: self.middle, directions: self.directions.clone(), is_hidden, of_all: None }
    }

    /// About the middle of the points.
    #[must_use]
    pub fn middle(&self) -> &Point3<f64> {
        &self.middle
    }

    /// Which points are hidden from a camera at `eye` once the pose has moved them: from the nearest direction that is
    /// known. Those that face away are not among them.
    #[must_use]
    pub fn from(&self, eye: &Point3<f64>, target_from_source: &Isometry3<f64>) -> &[bool] {
        let to_eye = target_from_source.inverse_transform_point(eye) - self.middle;
        let nearest = (0..self.directions.len())
            .max_by(|&a, &b| self.directions[a].dot(&to_eye).total_cmp(&self.directions[b].dot(&to_eye)));
        let Some(at) = nearest else { return &[] };
        match &self.of_all {
            None => &self.is_hidden[at],
            Some(OfAll { answer, is_hidden }) => {
                let spread = || answer.iter().map(|&i| self.is_hidden[at][i as usize]).collect();
                is_hidden[at].get_or_init(spread)
            }
        }
    }
}

/// At most [`MOST`] of the points, by row, which of them answers for each point, and the width of a voxel; `None` if
/// interrupted.
fn few(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    spacing: f64,
    interrupt: &Interrupt,
) -> Option<(Vec<u32>, Vec<u32>, f64)> {
    /// For each axis.
    const BITS: u32 = 20;
    let first = *points.first()?;
    let (low, high) = points.iter().fold((first, first), |(low, high), p| (low.inf(p), high.sup(p)));
    let least = (high - low).max() / f64::from((1 << BITS) - 1);
    let thinning = (points.len() as f64 / MOST as f64).sqrt();
    let mut width = (FIRST_WIDTH * spacing * thinning).max(least).max(f64::MIN_POSITIVE);
    let mut pace = Pace::new(interrupt);
    loop {
        let key = |p: &Point3<f64>, n: &Vector3<f64>| {
            let cells = [0, 1, 2].map(|axis| ((p[axis] - low[axis]) / width) as u64);
            let octant = n.iter().fold(0, |octant, &x| 2 * octant + u64::from(x < 0.0));
            cells.iter().fold(octant, |key, cell| key << BITS | cell)
        };
        let (mut answers, mut rows) = (HashMap::new(), Vec::new());
        let mut answer = Vec::with_capacity(points.len());
        for (row, (p, n)) in (0..).zip(points.iter().zip(normals)) {
            if pace.is_over(16) {
                return None;
            }
            let next = rows.len() as u32;
            let of = *answers.entry(key(p, n)).or_insert(next);
            if of == next {
                rows.push(row);
                if rows.len() > MOST {
                    break;
                }
            }
            answer.push(of);
        }
        if rows.len() <= MOST {
            return Some((rows, answer, width));
        }
        width *= WIDEN;
    }
}

/// Lower and upper corner of the box around places on a screen; infinite if there is none.
pub(crate) fn corners<'a>(places: impl IntoIterator<Item = &'a [f64; 2]>) -> ([f64; 2], [f64; 2]) {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    for at in places {
        for k in 0..2 {
            (low[k], high[k]) = (low[k].min(at[k]), high[k].max(at[k]));
        }
    }
    (low, high)
}

/// Which points are behind others, as seen from far away in the direction `to_eye`; nothing if interrupted.
fn hidden(
    points: &[Point3<f64>],
    normals: &[Vector3<f64>],
    spacing: f64,
    to_eye: &Vector3<f64>,
    interrupt: &Interrupt,
) -> Vec<bool> {
    if interrupt.is_set() {
        return Vec::new();
    }
    let [right, up] = across(to_eye);
    let on_screen: Vec<[f64; 2]> = points.iter().map(|p| [right.dot(&p.coords), up.dot(&p.coords)]).collect();
    let (low, high) = corners(&on_screen);
    let aside = ASIDE * spacing;
    let size = (high[0] - low[0]).max(high[1] - low[1]);
    let cell = aside.max(size / MAX_CELLS).max(f64::MIN_POSITIVE);
    let shape = [0, 1].map(|k| ((high[k] - low[k]) / cell) as usize + 1);
    let cell_of = |at: &[f64; 2]| [0, 1].map(|k| ((at[k] - low[k]) / cell) as usize);
    let index = |at: &[f64; 2]| {
        let [column, row] = cell_of(at);
        column * shape[1] + row
    };
    let (starts, mut rows) = buckets(shape[0] * shape[1], (0..).zip(on_screen.iter().map(index)));
    // Where many points share a cell, those that come first are nearest to the eye, and those too far back left out.
    let depth = |q: u32| points[q as usize].coords.dot(to_eye);
    let is_crowded = |cell: usize| starts[cell + 1] - starts[cell] > CROWDED;
    let crowded: Vec<usize> = (0..shape[0] * shape[1]).filter(|&cell| is_crowded(cell)).collect();
    for &cell in &crowded {
        let rows = &mut rows[starts[cell] as usize..starts[cell + 1] as usize];
        rows.sort_unstable_by(|&a, &b| depth(b).total_cmp(&depth(a)).then(a.cmp(&b)));
    }
    let hides = |q: usize, p: usize| {
        let gap = [0, 1].map(|k| on_screen[q][k] - on_screen[p][k]);
        let offset = points[q] - points[p];
        let before = offset.dot(to_eye);
        gap[0] * gap[0] + gap[1] * gap[1] < aside * aside
            && before > BEFORE * spacing
            && offset.dot(&normals[p]) > RISE * before
    };
    let mut pace = Pace::new(interrupt);
    let mut is_hidden = |p: usize| {
        let [column, row] = cell_of(&on_screen[p]);
        (column.saturating_sub(1)..(column + 2).min(shape[0])).any(|x| {
            let [first, last] = [row.saturating_sub(1), (row + 2).min(shape[1])].map(|y| x * shape[1] + y);
            let run = |from: usize, to: usize| &rows[starts[from] as usize..starts[to] as usize];
            if crowded.is_empty() || !(first..last).any(is_crowded) {
                return run(first, last).iter().any(|&q| hides(q as usize, p));
            }
            let least = depth(p as u32) + (1.0 - 1e-9) * BEFORE * spacing;
            (first..last).any(|cell| {
                let cell = run(cell, cell + 1);
                let is_sorted = cell.len() > CROWDED as usize;
                let before = if is_sorted { cell.partition_point(|&q| depth(q) > least) } else { cell.len() };
                !pace.is_over(before) && cell[..before].iter().any(|&q| hides(q as usize, p))
            })
        })
    };
    (0..points.len()).map(|p| normals[p].dot(to_eye) > 0.0 && is_hidden(p)).collect()
}

/// What lies at a place, as the camera measured it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sight {
    /// The camera saw something else before it.
    Hidden,
    /// The camera saw through it: what it measured there lies behind.
    Through,
    /// It may have been seen: a surface is near, or nothing was measured there.
    Open,
}

/// How far each pixel of a camera saw.
#[derive(Debug)]
pub struct RangeImage {
    eye: Point3<f64>,
    /// Right, down and forward; as a rotation of the target into the camera.
    axes: [Vector3<f64>; 3],
    low: [f64; 2],
    inv_pixel: f64,
    shape: [usize; 2],
    pixels: Vec<Pixel>,
}

/// The ranges in a pixel and those around it. Where nothing was measured: infinity and 0.
#[derive(Debug, Clone, Copy)]
struct Pixel {
    /// Nothing around it is nearer; 0 if a pixel around it saw nothing, so that it proves nothing.
    nearest: f32,
    /// Nothing around it is farther.
    farthest: f32,
}

/// Tangent of the widest angle to the axis that is looked at.
const MAX_TAN: f64 = 4.0;

/// Points that a pixel should have, if it has any: then a surface leaves few without.
const POINTS_PER_PIXEL: f64 = 3.0;

/// Pixels at most.
const MAX_PIXELS: f64 = 4e6;

impl RangeImage {
    /// Of all the points that a camera at `eye` measured, with pixels at least `pixel` wide at their mean distance
    /// (data units), and wider where the points are sparser than that. `None` if there is no point before the camera.
    ///
    /// # Complexity
    /// O(points + pixels), at most 4 million pixels.
    #[must_use]
    pub fn new(eye: Point3<f64>, points: &[Point3<f64>], pixel: f64) -> Option<Self> {
        let forward = points.iter().map(|p| p - eye).sum::<Vector3<f64>>();
        let forward = Unit::try_new(forward, 0.0)?.into_inner();
        let [right, down] = across(&forward);
        let axes = [right, down, forward];
        let rays: Vec<([f64; 2], f64)> = points.iter().filter_map(|p| ray(&axes, p - eye)).collect();
        let mean = rays.iter().map(|(_, range)| range).sum::<f64>() / rays.len().max(1) as f64;
        if rays.is_empty() {
            return None;
        }
        let (low, high) = corners(rays.iter().map(|(at, _)| at));
        let size = [0, 1].map(|k| high[k] - low[k]);
        let mut pixel = (pixel / mean).max((size[0] * size[1] / MAX_PIXELS).sqrt()).max(1e-6);
        loop {
            let image = Self::with_pixel(eye, axes, &rays, low, size, pixel);
            let num_seen = image.pixels.iter().filter(|pixel| pixel.farthest > 0.0).count();
            let is_one = image.pixels.len() == 1;
            if is_one || rays.len() as f64 >= POINTS_PER_PIXEL * num_seen as f64 {
                return Some(image.spread());
            }
            pixel *= 1.25;
        }
    }

    /// Each pixel by itself.
    fn with_pixel(
        eye: Point3<f64>,
        axes: [Vector3<f64>; 3],
        rays: &[([f64; 2], f64)],
        low: [f64; 2],
        size: [f64; 2],
        pixel: f64,
    ) -> Self {
        let inv_pixel = 1.0 / pixel;
        let shape = size.map(|size| (size * inv_pixel) as usize + 1);
        let nothing = Pixel { nearest: f32::INFINITY, farthest: 0.0 };
        let pixels = vec![nothing; shape[0] * shape[1]];
        let mut image = Self { eye, axes, low, inv_pixel, shape, pixels };
        for (at, range) in rays {
            if let Some(pixel) = image.pixel(at) {
                let seen = &mut image.pixels[pixel];
                let range = *range as f32;
                *seen = Pixel { nearest: seen.nearest.min(range), farthest: seen.farthest.max(range) };
            }
        }
        image
    }

    /// Each pixel with those around it.
    fn spread(self) -> Self {
        let [width, height] = self.shape;
        let around = |x: usize, y: usize| {
            let mut all = Pixel { nearest: f32::INFINITY, farthest: 0.0 };
            let mut is_full = x > 0 && y > 0 && x + 1 < width && y + 1 < height;
            for column in x.saturating_sub(1)..(x + 2).min(width) {
                for row in y.saturating_sub(1)..(y + 2).min(height) {
                    let pixel = self.pixels[column * height + row];
                    is_full &= pixel.farthest > 0.0;
                    all.nearest = all.nearest.min(pixel.nearest);
                    all.farthest = all.farthest.max(pixel.farthest);
                }
            }
            if !is_full {
                all.nearest = 0.0;
            }
            all
        };
        let pixels = (0..width * height).map(|i| around(i / height, i % height)).collect();
        Self { pixels, ..self }
    }

    /// What was measured at `point`, of the target's frame, give or take `tolerance` in range. Edges are blurred by a
    /// pixel on each side: a point is hidden, or seen through, if it is so for all pixels around it.
    #[must_use]
    pub fn sight(&self, point: &Point3<f64>, tolerance: f64) -> Sight {
        let Some((at, range)) = ray(&self.axes, point - self.eye) else { return Sight::Open };
        let Some(pixel) = self.pixel(&at) else { return Sight::Open };
        let Pixel { nearest, farthest } = self.pixels[pixel];
        if farthest > 0.0 && f64::from(farthest) < range - tolerance {
            Sight::Hidden
        } else if f64::from(nearest) > range + tolerance {
            Sight::Through
        } else {
            Sight::Open
        }
    }

    fn pixel(&self, at: &[f64; 2]) -> Option<usize> {
        let [x, y] = [0, 1].map(|k| (at[k] - self.low[k]) * self.inv_pixel);
        let is_in = x >= 0.0 && y >= 0.0 && x < self.shape[0] as f64 && y < self.shape[1] as f64;
        is_in.then(|| x as usize * self.shape[1] + y as usize)
    }
}

/// Where a ray to a point meets the screen at distance 1, and the distance of the point; `None` if it is not before the
/// camera, or too far aside.
fn ray([right, down, forward]: &[Vector3<f64>; 3], offset: Vector3<f64>) -> Option<([f64; 2], f64)> {
    let depth = forward.dot(&offset);
    let at = [right.dot(&offset), down.dot(&offset)];
    let is_before = depth > 0.0 && at[0].abs().max(at[1].abs()) <= MAX_TAN * depth;
    is_before.then(|| (at.map(|x| x / depth), offset.norm()))
}
