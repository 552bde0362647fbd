//! Shapes in the plane of sets given by half-spaces.

use nalgebra::{Matrix4, Vector4};

use super::chart::Points;
use crate::mission::model::HalfSpaces;

/// Most choices of four rows that are tried: sets of 80 rows have fewer.
const CHOICES_MAX: usize = 2_000_000;

/// Largest size of what is drawn: a set that reaches further has no shadow.
const FAR: f64 = 1e6;

/// The shadow of a set of four components on the first two: the hull of its corners, which are
/// found by trying every four rows. `None` for sets of too many rows.
pub(super) fn shadow(set: &HalfSpaces) -> Option<Points> {
    let rows = set.offsets.len();
    let choices =
        (0..4).fold(1, |product: usize, i| product.saturating_mul(rows.saturating_sub(i)));
    if set.normals.ncols() != 4 || choices / 24 > CHOICES_MAX {
        return None;
    }
    let mut corners = Points::new();
    for a in 0..rows {
        for b in a + 1..rows {
            for c in b + 1..rows {
                for d in c + 1..rows {
                    corners.extend(corner(set, [a, b, c, d]));
                }
            }
        }
    }
    Some(hull(corners))
}

/// Where four rows meet, if that is in the set.
fn corner(set: &HalfSpaces, rows: [usize; 4]) -> Option<(f64, f64)> {
    let normals = Matrix4::from_fn(|i, j| set.normals[(rows[i], j)]);
    let offsets = Vector4::from_fn(|i, _| set.offsets[rows[i]]);
    let x = normals.lu().solve(&offsets).filter(|x| x.amax() < FAR)?;
    let inside = (0..set.offsets.len()).all(|row| {
        let product: f64 = (0..4).map(|j| set.normals[(row, j)] * x[j]).sum();
        // Rounding of the solution, relative to the numbers that went into it.
        product <= set.offsets[row] + 1e-9 * (1.0 + set.offsets[row].abs())
    });
    inside.then(|| (x[0], x[1]))
}

/// The points of a set at which all components but the first two are zero.
pub(super) fn slice_at_rest(set: &HalfSpaces) -> Points {
    let mut polygon = vec![(-FAR, -FAR), (FAR, -FAR), (FAR, FAR), (-FAR, FAR)];
    for row in 0..set.offsets.len() {
        let depth = |(x, y): (f64, f64)| {
            set.offsets[row] - set.normals[(row, 0)] * x - set.normals[(row, 1)] * y
        };
        polygon = clipped(&polygon, depth);
    }
    polygon
}

/// The part of a convex polygon at which `depth`, an affine function, is not negative.
fn clipped(polygon: &[(f64, f64)], depth: impl Fn((f64, f64)) -> f64) -> Points {
    let mut kept = Points::new();
    for (index, &from) in polygon.iter().enumerate() {
        let to = polygon[(index + 1) % polygon.len()];
        let (a, b) = (depth(from), depth(to));
        if a >= 0.0 {
            kept.push(from);
        }
        if (a < 0.0) != (b < 0.0) {
            let share = a / (a - b);
            kept.push((from.0 + share * (to.0 - from.0), from.1 + share * (to.1 - from.1)));
        }
    }
    kept
}

/// Corners of the convex hull, counter-clockwise (Andrew's monotone chain).
fn hull(mut points: Points) -> Points {
    points.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    points.dedup();
    if points.len() < 3 {
        return points;
    }
    let chain = |points: &mut dyn Iterator<Item = (f64, f64)>| {
        let mut chain = Points::new();
        for point in points {
            while chain.len() >= 2
                && turn(chain[chain.len() - 2], chain[chain.len() - 1], point) <= 0.0
            {
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut outline = chain(&mut points.iter().copied());
    outline.extend(chain(&mut points.iter().rev().copied()));
    outline
}

/// Positive for a turn to the left at `b`.
fn turn(a: (f64, f64), b: (f64, f64), c: (f64, f64)) -> f64 {
    (b.0 - a.0) * (c.1 - a.1) - (b.1 - a.1) * (c.0 - a.0)
}

/// A circle about a point.
pub(super) fn circle((x, y): (f64, f64), radius: f64) -> Points {
    let corner = |i: i32| {
        let (s, c) = (std::f64::consts::TAU * f64::from(i) / 72.0).sin_cos();
        (x + radius * c, y + radius * s)
    };
    (0..72).map(corner).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    fn has(points: &[(f64, f64)], expected: &[(f64, f64)]) {
        let near = |a: &(f64, f64), b: &(f64, f64)| (a.0 - b.0).hypot(a.1 - b.1) < 1e-9;
        assert_eq!(points.len(), expected.len(), "{points:?}");
        assert!(expected.iter().all(|e| points.iter().any(|p| near(p, e))), "{points:?}");
    }

    /// |x|, |y| <= 1 with velocities within 1 of their positions: the shadow is the square, the
    /// slice at rest too; with x + v_x <= 1 the shadow stays and the slice does too, with
    /// x - v_x <= 0.5 and |v_x| <= 0.25 the shadow ends at 0.75 and the slice at 0.5.
    #[test]
    fn region_of_a_known_set() {
        let mut rows: Vec<[f64; 4]> = Vec::new();
        for axis in 0..4 {
            for sign in [1.0, -1.0] {
                let mut row = [0.0; 4];
                row[axis] = sign;
                rows.push(row);
            }
        }
        let mut offsets = vec![1.0, 1.0, 1.0, 1.0, 0.25, 0.25, 0.25, 0.25];
        let set = |rows: &[[f64; 4]], offsets: &[f64]| HalfSpaces {
            normals: DMatrix::from_fn(rows.len(), 4, |i, j| rows[i][j]),
            offsets: DVector::from_column_slice(offsets),
        };
        let square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
        has(&shadow(&set(&rows, &offsets)).expect("few rows"), &square);
        has(&slice_at_rest(&set(&rows, &offsets)), &square);
        rows.push([1.0, 0.0, -1.0, 0.0]);
        offsets.push(0.5);
        let cut = |x: f64| [(-1.0, -1.0), (x, -1.0), (x, 1.0), (-1.0, 1.0)];
        has(&shadow(&set(&rows, &offsets)).expect("few rows"), &cut(0.75));
        has(&slice_at_rest(&set(&rows, &offsets)), &cut(0.5));
    }
}
