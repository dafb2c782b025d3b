//! Rotations that are nearly a group, made one.

use nalgebra::{Quaternion, UnitQuaternion};

type Turn = UnitQuaternion<f64>;

/// Rotations nearer to each other than this are the same, which is less than half of the least turn that is looked for.
pub(super) const SAME_RAD: f64 = 0.12;

/// A group with more members than this is taken for none: its turns are as good as any angle.
const MOST: usize = 120;

/// Averages until nothing changes: each squares what is wrong.
const AVERAGES: usize = 6;

/// The row of the rotation that is `turn`.
pub(super) fn find(turns: &[Turn], turn: &Turn) -> Option<usize> {
    turns.iter().position(|other| other.angle_to(turn) < SAME_RAD)
}

/// What the members of a group generate together with one more rotation; `None` if that is no finite group, or a very
/// large one. The identity comes first, then the members.
pub(super) fn closure(group: &[Turn], with: Turn) -> Option<Vec<Turn>> {
    let generators: Vec<Turn> = group.iter().skip(1).copied().chain([with]).collect();
    let mut all = group.to_vec();
    let mut next = 0;
    while next < all.len() {
        for generator in &generators {
            let product = all[next] * generator;
            if find(&all, &product).is_none() {
                all.push(product);
            }
        }
        if all.len() > MOST {
            return None;
        }
        next += 1;
    }
    averaged(&all)
}

/// The group nearest to rotations that are nearly one: each becomes the mean of all quotients that should be it, again
/// and again (Grove, Karcher & Ruh, "Group actions and curvature", Inventiones 23, 1974). `None` if a product is no member.
fn averaged(turns: &[Turn]) -> Option<Vec<Turn>> {
    let n = turns.len();
    let table: Option<Vec<usize>> =
        turns.iter().flat_map(|a| turns.iter().map(move |b| find(turns, &(a * b)))).collect();
    let table = table?;
    let mut turns = turns.to_vec();
    for _ in 0..AVERAGES {
        let mut sums = vec![Quaternion::new(0.0, 0.0, 0.0, 0.0); n];
        for a in 0..n {
            for b in 0..n {
                let quotient = (turns[table[a * n + b]] * turns[b].inverse()).into_inner();
                // A quaternion and its negative are the same rotation.
                sums[a] += quotient * turns[a].dot(&quotient).signum();
            }
        }
        turns = sums.into_iter().map(UnitQuaternion::new_normalize).collect();
    }
    // That of the identity: exactly so, and not to rounding.
    turns[0] = UnitQuaternion::identity();
    let is_member = |a: &Turn, b: &Turn| turns.iter().any(|c| c.angle_to(&(a * b)) < 1e-9);
    turns.iter().all(|a| turns.iter().all(|b| is_member(a, b))).then_some(turns)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests may panic")]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use proptest::prelude::*;
    use std::f64::consts::{PI, TAU};

    fn turn(axis: [f64; 3], angle: f64) -> Turn {
        Turn::from_scaled_axis(Vector3::from(axis).normalize() * angle)
    }

    /// Generators and the order of what they generate.
    fn groups() -> Vec<(Vec<Turn>, usize)> {
        let (x, z, diagonal) = ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]);
        let golden = [0.0, 1.0, f64::midpoint(1.0, 5_f64.sqrt())];
        let cyclic = |n: u32| (vec![turn(z, TAU / f64::from(n))], n as usize);
        let dihedral = |n: u32| (vec![turn(z, TAU / f64::from(n)), turn(x, PI)], 2 * n as usize);
        let mut groups: Vec<_> = (2..=24).flat_map(|n| [cyclic(n), dihedral(n)]).collect();
        groups.push((vec![turn(z, PI), turn(diagonal, TAU / 3.0)], 12));
        groups.push((vec![turn(z, TAU / 4.0), turn(diagonal, TAU / 3.0)], 24));
        groups.push((vec![turn(golden, TAU / 5.0), turn(diagonal, TAU / 3.0)], 60));
        groups
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(16))]
        #[test]
        fn closes_the_finite_rotation_groups_from_noisy_generators(
            noise in prop::collection::vec(prop::array::uniform3(-0.002..0.002), 2),
            frame in prop::array::uniform3(-3.0..3.0),
        ) {
            let frame = Turn::from_scaled_axis(frame.into());
            for (generators, order) in groups() {
                let mut group = vec![Turn::identity()];
                for (generator, noise) in generators.iter().zip(&noise) {
                    // Of the angle only by so much as the search leaves: it is brought to a fraction of a turn there.
                    let off = Turn::from_scaled_axis(Vector3::from(*noise));
                    let generator = frame * off * generator * off.inverse() * frame.inverse();
                    let larger = closure(&group, generator);
                    prop_assert!(larger.is_some(), "of order {order}");
                    group = larger.unwrap();
                }
                prop_assert_eq!(group.len(), order);
                for a in &group {
                    for b in &group {
                        prop_assert!(group.iter().any(|c| c.angle_to(&(a * b)) < 1e-9));
                    }
                }
                for generator in &generators {
                    let moved = frame * generator * frame.inverse();
                    prop_assert!(group.iter().any(|c| c.angle_to(&moved) < 0.03));
                }
            }
        }
    }

    #[test]
    fn turns_by_any_angle_are_no_finite_group() {
        assert_eq!(closure(&[Turn::identity()], turn([0.0, 0.0, 1.0], 1.0)), None);
    }
}
