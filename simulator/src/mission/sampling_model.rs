//! The simulator's own reading of an offline-sampling problem: what is measured, and which rules
//! a flight is judged by.

use nalgebra::{DMatrix, DVector};
use vbar_proto::v1::{self, offline_sampling_problem::Plant};

use super::{
    model::{HalfSpaces, matrix},
    sampling::offline_sampling,
};

/// What is flown and by which rules, with the target at the origin.
#[derive(Debug, Clone)]
pub(crate) struct SamplingModel {
    /// Between two commands.
    pub sample_time_s: f64,
    /// Measured as position and velocity in RTN instead of components.
    pub relative: bool,
    /// Rows that may be violated with the probability `violation`.
    pub state_set: HalfSpaces,
    /// What each row of `state_set` means.
    pub row_names: Vec<String>,
    /// Rows that always hold.
    pub input_set: HalfSpaces,
    /// The cone in the plane, if there is one.
    pub cone: Option<Cone>,
    /// epsilon, if constraints are sampled.
    pub violation: Option<f64>,
}

/// The part of the plane of the first two components within an angle of an axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Cone {
    pub apex_m: [f64; 2],
    pub axis_rad: f64,
    pub half_angle_rad: f64,
    /// Largest distance from the apex along the axis.
    pub range_max_m: Option<f64>,
}

const HERE: &str = "problem.offline_sampling";

impl SamplingModel {
    /// Reads a problem; all faults are returned together.
    pub(crate) fn new(problem: &v1::Problem) -> Result<Self, Vec<String>> {
        let mut faults = Vec::new();
        let Some(inner) = offline_sampling(problem) else {
            return Err(vec![format!("{HERE}: required")]);
        };
        let (relative, states, inputs, sample_time_s) = match &inner.plant {
            Some(Plant::Poseidyn(plant)) => (false, 4, 2, plant.sample_time_s),
            Some(Plant::UncertainHill(plant)) => (true, 6, 3, plant.sample_time_s),
            Some(Plant::Polynomial(plant)) => {
                let columns = |given: Option<&v1::MatrixPolynomial>| {
                    let constant = given.and_then(|matrix| matrix.constant.as_ref());
                    constant.map_or(0, |matrix| usize::try_from(matrix.columns).unwrap_or(0))
                };
                let (states, inputs) = (columns(plant.a.as_ref()), columns(plant.b.as_ref()));
                (false, states, inputs, plant.sample_time_s)
            }
            None => return Err(vec![format!("{HERE}.plant: required")]),
        };
        let sample_time_s = sample_time_s.unwrap_or(f64::NAN);
        if !(sample_time_s.is_finite() && sample_time_s > 0.0) {
            faults.push(format!("{HERE}: the plant's sample time, greater than 0, is required"));
        }
        let cone = inner.cone.as_ref().and_then(|given| Cone::read(given, &mut faults));
        let place = format!("{HERE}.state_set");
        let given =
            inner.state_set.as_ref().map(|set| half_spaces(&place, set, states, &mut faults));
        let mut state_set = given.unwrap_or_else(|| HalfSpaces {
            normals: DMatrix::zeros(0, states),
            offsets: DVector::zeros(0),
        });
        let mut row_names: Vec<String> =
            (0..state_set.offsets.len()).map(|row| format!("state_set[{row}]")).collect();
        if let Some(cone) = cone {
            for (name, normal, offset) in cone.rows() {
                let row = state_set.offsets.len();
                let columns = state_set.normals.ncols();
                state_set.normals = state_set.normals.insert_row(row, 0.0);
                if columns >= 2 {
                    state_set.normals[(row, 0)] = normal[0];
                    state_set.normals[(row, 1)] = normal[1];
                }
                state_set.offsets = state_set.offsets.push(offset);
                row_names.push(name.to_owned());
            }
        }
        let empty = v1::PolytopeSet::default();
        let place = format!("{HERE}.input_set");
        let input_set = inner.input_set.as_ref().unwrap_or(&empty);
        let input_set = half_spaces(&place, input_set, inputs, &mut faults);
        let violation = inner.samples.as_ref().and_then(|samples| samples.violation);
        if !faults.is_empty() {
            return Err(faults);
        }
        Ok(Self { sample_time_s, relative, state_set, row_names, input_set, cone, violation })
    }

    /// n.
    pub(crate) fn states(&self) -> usize {
        self.state_set.normals.ncols()
    }

    /// m.
    pub(crate) fn inputs(&self) -> usize {
        self.input_set.normals.ncols()
    }
}

impl Cone {
    fn read(given: &v1::PlanarCone, faults: &mut Vec<String>) -> Option<Self> {
        let place = format!("{HERE}.cone");
        let (axis_deg, half_angle_deg) = (given.axis_deg?, given.half_angle_deg?);
        let [x, y] = given.apex_m[..] else {
            faults.push(format!("{place}.apex_m: two components"));
            return None;
        };
        let finite = [x, y, axis_deg].iter().all(|value| value.is_finite());
        if !(finite && half_angle_deg > 0.0 && half_angle_deg < 90.0) {
            faults.push(format!("{place}: finite, half angle between 0 and 90"));
            return None;
        }
        Some(Self {
            apex_m: [x, y],
            axis_rad: axis_deg.to_radians(),
            half_angle_rad: half_angle_deg.to_radians(),
            range_max_m: given.range_max_m,
        })
    }

    /// The unit vector at `angle_rad` from the axis, counted as the axis is.
    fn direction(&self, angle_rad: f64) -> [f64; 2] {
        let (s, c) = (self.axis_rad + angle_rad).sin_cos();
        [c, s]
    }

    /// Outward normals and offsets of its faces.
    fn rows(&self) -> Vec<(&'static str, [f64; 2], f64)> {
        let quarter = std::f64::consts::FRAC_PI_2;
        let along = |normal: [f64; 2]| normal[0] * self.apex_m[0] + normal[1] * self.apex_m[1];
        let left = self.direction(self.half_angle_rad + quarter);
        let right = self.direction(-self.half_angle_rad - quarter);
        let mut rows =
            vec![("cone, left face", left, along(left)), ("cone, right face", right, along(right))];
        if let Some(range) = self.range_max_m {
            let axis = self.direction(0.0);
            rows.push(("cone, far end", axis, along(axis) + range));
        }
        rows
    }

    /// Its apex and the far ends of its faces, `length_m` along the axis where it has no end.
    pub(crate) fn corners(&self, length_m: f64) -> [[f64; 2]; 3] {
        let slant = self.range_max_m.unwrap_or(length_m) / self.half_angle_rad.cos();
        let end = |angle: f64| {
            let along = self.direction(angle);
            [self.apex_m[0] + slant * along[0], self.apex_m[1] + slant * along[1]]
        };
        [self.apex_m, end(-self.half_angle_rad), end(self.half_angle_rad)]
    }
}

/// A polytope of `columns` columns.
pub(crate) fn half_spaces(
    place: &str,
    given: &v1::PolytopeSet,
    columns: usize,
    faults: &mut Vec<String>,
) -> HalfSpaces {
    let normals = matrix(&format!("{place}.normals"), given.normals.as_ref(), faults);
    if normals.ncols() != columns || normals.nrows() != given.offsets.len() {
        faults.push(format!("{place}: {columns} columns, an offset a row"));
    }
    if given.offsets.iter().any(|offset| !offset.is_finite()) {
        faults.push(format!("{place}.offsets: finite"));
    }
    HalfSpaces { normals, offsets: DVector::from_column_slice(&given.offsets) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mission::sampling::SamplingMission;

    /// The cone of [Mammarella2019, sec. III.B] by its corners, seen from the target.
    #[test]
    fn sampling_model_has_the_papers_cone() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("missions");
        let mission = SamplingMission::load(&folder.join("poseidyn.json")).expect("a mission");
        let model = mission.model().expect("a model");
        let target = &mission.simulation.target_m;
        let corners = model.cone.expect("a cone").corners(1.0);
        for (corner, printed) in corners.iter().zip([[0.0, 0.0], [4.0, 2.25], [2.25, 4.0]]) {
            for axis in 0..2 {
                let error = corner[axis] + target[axis] - printed[axis];
                assert!(error.abs() < 1e-9, "{corner:?} for {printed:?}");
            }
        }
        // A corner lies on the two faces that meet there, and the middle inside all.
        let cone_rows = model.row_names.iter().filter(|name| name.starts_with("cone")).count();
        assert_eq!(cone_rows, 3);
        for corner in corners {
            let state = DVector::from_vec(vec![corner[0], corner[1], 0.0, 0.0]);
            assert!(model.state_set.margin(&state).abs() < 1e-9, "{corner:?}");
        }
        let inside = DVector::from_vec(vec![2.0, 2.0, 0.0, 0.0]);
        assert!(model.state_set.margin(&inside) > 0.05);
    }
}
