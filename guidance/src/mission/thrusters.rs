//! Thrusters, and which of them may fail.

use nalgebra::{DMatrix, DVector, Vector3};

use crate::{sets::Zonotope, units::Force};

/// Most thrusters of a craft: a mode is a set of bits.
pub const THRUSTERS_MAX: usize = 16;

/// One thruster, fixed in RTN because the chaser holds its attitude there, through the centre of
/// mass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thruster {
    /// Unit vector of the force on the chaser, RTN.
    direction: Vector3<f64>,
    force_max: Force,
}

/// The thrusters of a chaser.
#[derive(Debug, Clone, PartialEq)]
pub struct Thrusters {
    list: Vec<Thruster>,
}

/// The thrusters that work, as bits: bit j for thruster j, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ThrustMode(u32);

impl Thruster {
    /// A thruster that pushes the chaser along `direction` (any length) with up to `force_max`.
    ///
    /// `None` if the direction has no length or the force is not positive and finite.
    #[must_use]
    pub fn new(direction: Vector3<f64>, force_max: Force) -> Option<Self> {
        let length = direction.norm();
        let force = force_max.newtons();
        (length > 0.0 && length.is_finite() && force > 0.0 && force.is_finite())
            .then(|| Self { direction: direction / length, force_max })
    }

    /// A thruster whose direction has length 1 already, kept to the last bit, so that what is
    /// written and read back is the same.
    pub(crate) fn exactly(direction: Vector3<f64>, force_max: Force) -> Option<Self> {
        let unit = (direction.norm() - 1.0).abs() < 1e-12;
        Self::new(direction, force_max).filter(|_| unit).map(|_| Self { direction, force_max })
    }

    /// Unit vector of the force on the chaser, RTN.
    #[must_use]
    pub fn direction(&self) -> &Vector3<f64> {
        &self.direction
    }

    /// Largest force.
    #[must_use]
    pub fn force_max(&self) -> Force {
        self.force_max
    }

    /// The force at full thrust, newtons, RTN.
    #[must_use]
    pub fn full_force_n(&self) -> Vector3<f64> {
        self.direction * self.force_max.newtons()
    }
}

impl Thrusters {
    /// At most [`THRUSTERS_MAX`] thrusters; `None` beyond, or without any.
    #[must_use]
    pub fn new(list: Vec<Thruster>) -> Option<Self> {
        (1..=THRUSTERS_MAX).contains(&list.len()).then_some(Self { list })
    }

    /// Eight equal thrusters along the corners of a cube, tau_1 = (+++), tau_2 = (++-), ...,
    /// tau_8 = (---) over sqrt 3. The paper's own figure 2 is not in its text; these directions
    /// reproduce its numbers. `None` if the force is not positive. [AguilarMarsillach2022, VI]
    #[must_use]
    pub fn cube_corners(force_max: Force) -> Option<Self> {
        let sign = |bits: usize, bit: usize| if bits >> bit & 1 == 0 { 1.0 } else { -1.0 };
        let corner = |i| Vector3::new(sign(i, 2), sign(i, 1), sign(i, 0));
        (0..8)
            .map(|i| Thruster::new(corner(i), force_max))
            .collect::<Option<_>>()
            .and_then(Self::new)
    }

    /// The thrusters, from 0.
    #[must_use]
    pub fn list(&self) -> &[Thruster] {
        &self.list
    }

    /// Forces at full thrust, newtons.
    #[must_use]
    pub fn full_forces_n(&self) -> Vec<Vector3<f64>> {
        self.list.iter().map(Thruster::full_force_n).collect()
    }

    /// All thrusters work.
    #[must_use]
    pub fn nominal(&self) -> ThrustMode {
        ThrustMode((1 << self.list.len()) - 1)
    }

    /// Every mode but the nominal one, total failure first: 2^m - 1.
    #[must_use]
    pub fn failure_modes(&self) -> Vec<ThrustMode> {
        (0..self.nominal().0).map(ThrustMode).collect()
    }

    /// Forces that the working thrusters can make, newtons: a zonotope that holds 0 on its
    /// border or inside. [AguilarMarsillach2022, eq. 9]
    #[must_use]
    pub fn admissible(&self, mode: ThrustMode) -> Zonotope {
        let halves: Vec<DVector<f64>> = mode
            .working()
            .filter_map(|j| self.list.get(j))
            .map(|t| DVector::from_column_slice((t.full_force_n() * 0.5).as_slice()))
            .collect();
        if halves.is_empty() {
            return Zonotope::centred(DMatrix::zeros(3, 0));
        }
        let centre = halves.iter().fold(DVector::zeros(3), |sum, g| sum + g);
        Zonotope::new(centre, DMatrix::from_columns(&halves))
    }
}

impl ThrustMode {
    /// Total failure.
    pub const NONE: Self = Self(0);

    /// The given thrusters, from 0, work; indices beyond 31 are not representable and give `None`.
    pub fn of(working: impl IntoIterator<Item = usize>) -> Option<Self> {
        working.into_iter().try_fold(0, |bits, j| (j < 32).then(|| bits | 1 << j)).map(Self)
    }

    /// The bits.
    #[must_use]
    pub const fn bits(self) -> u32 {
        self.0
    }

    /// From the bits.
    #[must_use]
    pub const fn from_bits(bits: u32) -> Self {
        Self(bits)
    }

    /// The working thrusters, from 0, in order.
    pub fn working(self) -> impl Iterator<Item = usize> {
        (0..32).filter(move |j| self.0 >> j & 1 == 1)
    }

    /// Does every thruster that works here work there too?
    #[must_use]
    pub const fn is_within(self, other: Self) -> bool {
        self.0 & !other.0 == 0
    }
}

/// The modes whose backward reachable sets hold those of all the others, in their given order.
///
/// 0 is admissible in every mode, so a mode with fewer working thrusters has a smaller admissible
/// set and larger backward reachable sets [AguilarMarsillach2022, prop. III.2]: a mode is needed
/// only if no other one of the list works with a part of its thrusters. With total failure in the
/// list it alone is needed.
#[must_use]
pub fn dominating_modes(modes: &[ThrustMode]) -> Vec<ThrustMode> {
    let mut needed: Vec<ThrustMode> = Vec::new();
    for &mode in modes {
        let dominated = modes.iter().any(|&other| other != mode && other.is_within(mode));
        if !dominated && !needed.contains(&mode) {
            needed.push(mode);
        }
    }
    needed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sets::ConvexSet;

    fn cube() -> Thrusters {
        Thrusters::cube_corners(Force::from_newtons(20.0)).unwrap()
    }

    #[test]
    fn corners_are_in_the_papers_order() {
        let cube = cube();
        let third = 20.0 / 3.0_f64.sqrt();
        assert!((cube.full_forces_n()[1] - Vector3::new(third, third, -third)).norm() < 1e-14);
        assert!((cube.full_forces_n()[4] - Vector3::new(-third, third, third)).norm() < 1e-14);
        assert_eq!(cube.failure_modes().len(), 255);
    }

    #[test]
    fn a_mode_supports_what_its_thrusters_give() {
        let cube = cube();
        let mode = ThrustMode::of([6, 7]).unwrap();
        let set = cube.admissible(mode);
        let along = |x: [f64; 3]| set.support_function(&DVector::from_column_slice(&x));
        assert!((along([-1.0, 0.0, 0.0]) - 40.0 / 3.0_f64.sqrt()).abs() < 1e-12);
        assert!(along([1.0, 0.0, 0.0]).abs() < 1e-12, "0 is admissible and nothing pushes up");
        assert_eq!(cube.admissible(ThrustMode::NONE).support_function(&DVector::zeros(3)), 0.0);
    }

    #[test]
    fn total_failure_dominates_all_and_singles_dominate_the_rest() {
        let cube = cube();
        let all = cube.failure_modes();
        assert_eq!(dominating_modes(&all), [ThrustMode::NONE]);
        let partial = &all[1..];
        let singles: Vec<ThrustMode> = (0..8).map(|j| ThrustMode::of([j]).unwrap()).collect();
        assert_eq!(dominating_modes(partial), singles);
    }

    #[test]
    fn nonsense_is_refused() {
        let force = Force::from_newtons(1.0);
        assert_eq!(Thruster::new(Vector3::zeros(), force), None);
        assert_eq!(Thruster::new(Vector3::x(), Force::from_newtons(-1.0)), None);
        assert_eq!(Thrusters::new(Vec::new()), None);
        assert_eq!(ThrustMode::of([32]), None);
    }
}
