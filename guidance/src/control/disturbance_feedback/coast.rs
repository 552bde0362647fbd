//! Between two burns: where the chaser is planned to be, and where it can be.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{
    Gain, PlannedState,
    model::LinearModel,
    outcome::{Effects, effects_after_burn, physical_values, sum_shape},
};
use crate::{
    dynamics::{TschaunerHempel, yamanaka_ankersen},
    frames::{InFrame, LvlhCcsds, RelativeState},
    matrices::{frobenius, product, solve_lower},
    orbit::KeplerOrbit,
    units::{Angle, Seconds},
};

/// The coast after one burn.
#[derive(Debug, Clone, PartialEq)]
pub struct Coast {
    orbit: KeplerOrbit,
    start: Seconds,
    end: Seconds,
    anomaly: Angle,
    /// Nominal state just after the burn, physical.
    state: DVector<f64>,
    /// What the true state just after the burn is off by, scaled: the corrected effects of every
    /// disturbance so far, then one navigation error.
    roots: Effects,
}

/// A moment of a coast.
#[derive(Debug, Clone, PartialEq)]
pub struct CoastState {
    /// Nominal.
    pub state: RelativeState<LvlhCcsds>,
    /// 6 x 6, `LVLH_CCSDS`, m and m/s: {d : d' shape^-1 d <= 1} around the nominal state contains
    /// the true state of every flight inside the assumed errors.
    pub outer_shape: DMatrix<f64>,
}

impl Coast {
    pub(super) fn new(
        orbit: &KeplerOrbit,
        model: &LinearModel,
        k: usize,
        burn: &Vector3<f64>,
        states: &[PlannedState],
        gains: &[Gain],
    ) -> Self {
        let mut state = physical_values(&states[k].state);
        (0..3).for_each(|axis| state[3 + axis] += burn[axis]);
        let mut roots = effects_after_burn(model, k, gains);
        roots.push(model.errors[k].root().clone());
        let (start, end, anomaly) = (model.elapsed[k], model.elapsed[k + 1], model.anomalies[k]);
        Self { orbit: *orbit, start, end, anomaly, state, roots }
    }

    /// When the burn is that it begins with.
    #[must_use]
    pub fn start(&self) -> Seconds {
        self.start
    }

    /// When the next instant is.
    #[must_use]
    pub fn end(&self) -> Seconds {
        self.end
    }

    /// The moment `elapsed` after the mission's start, which should lie in the coast.
    ///
    /// Each root is carried on by itself and the outer ellipsoid of their sum taken there, with the
    /// least trace in units of a navigation error: an ellipsoid of the sum at the burn, carried on,
    /// would forget that corrections cancel what they were made for, and grow without reason.
    #[must_use]
    pub fn at(&self, elapsed: Seconds) -> CoastState {
        let here = self.orbit.true_anomaly_after(elapsed);
        let since = Seconds::from_seconds(elapsed.seconds() - self.start.seconds());
        let scaled = yamanaka_ankersen(&self.orbit, self.anomaly, here, since);
        let (from, to) = (
            TschaunerHempel::new(&self.orbit, self.anomaly),
            TschaunerHempel::new(&self.orbit, here),
        );
        let carried: Vec<DMatrix<f64>> =
            self.roots.iter().map(|root| product(&scaled, root)).collect();
        // A fresh navigation error of the same size here, as the measure: lower triangular.
        let fresh = self.roots.last().map(|error| {
            let turn = product(&to.scaled_from_physical(), &from.physical_from_scaled());
            product(&turn, error)
        });
        let size = |root: &DMatrix<f64>| {
            fresh.as_ref().map_or(1.0, |error| frobenius(&solve_lower(error, root)))
        };
        let sizes: Vec<f64> = carried.iter().map(size).collect();
        let roots: Vec<&DMatrix<f64>> = carried.iter().collect();
        let back = to.physical_from_scaled();
        let shape = product(&product(&back, &sum_shape(&roots, &sizes)), &back.transpose());
        let start = DMatrix::from_column_slice(6, 1, self.state.as_slice());
        let there = product(&from.scaled_from_physical(), &start);
        let state = product(&back, &product(&scaled, &there));
        CoastState {
            state: RelativeState {
                position_m: InFrame::new(Vector3::new(state[0], state[1], state[2])),
                velocity_m_s: InFrame::new(Vector3::new(state[3], state[4], state[5])),
            },
            // Exactly symmetric: the two halves are sums in different orders.
            outer_shape: DMatrix::from_fn(6, 6, |i, j| 0.5 * (shape[(i, j)] + shape[(j, i)])),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{super::plan as make_plan, super::*, *};
    use crate::{
        budget::Budget,
        sets::{Ellipsoid, OuterSum},
        units::Distance,
    };

    /// Prisma in 5 hours with 6 instants [Deaconu2014, sec. V].
    fn prisma() -> Problem {
        let state = |position: [f64; 3], velocity: [f64; 3]| RelativeState {
            position_m: InFrame::new(position.into()),
            velocity_m_s: InFrame::new(velocity.into()),
        };
        let radii = [0.02, 0.02, 0.02, 2e-3, 2e-3, 2e-3];
        let a = Distance::from_metres(7.011e6);
        Problem {
            orbit: KeplerOrbit::new(a, 0.004, Angle::from_radians(0.0), None).unwrap(),
            epoch: None,
            initial: state([1e4, 0.0, 0.0], [0.0; 3]),
            target_state: state([330.0, 0.0, 30.0], [0.0, 0.0, -0.0158]),
            instants: Instants::EqualTime { count: 6, duration: Seconds::from_seconds(18_000.0) },
            delta_v_max_m_s: 0.26,
            navigation_errors: vec![Ellipsoid::from_semi_axes(&radii).unwrap()],
            outer_sum: OuterSum::MinVolume,
            metric: ArrivalMetric::Position,
            fuel_weight: 1.0,
            effort_weight: 1e-2,
            compare_open_loop: false,
        }
    }

    #[test]
    fn coast_ends_where_the_plan_says_and_never_outside_its_bound() {
        let plan = make_plan(&prisma(), Budget::UNLIMITED).unwrap();
        let states = &plan.outcome().states;
        for k in 0..5 {
            let coast = plan.coast(k).unwrap();
            assert_eq!((coast.start(), coast.end()), (states[k].elapsed, states[k + 1].elapsed));
            let end = coast.at(coast.end());
            let (found, planned) = (physical_values(&end.state), &states[k + 1]);
            let miss = found - physical_values(&planned.state);
            // Rounding of 10 km carried on for an hour.
            assert!(miss.amax() < 1e-7, "{k}: {miss}");
            // The plan's bound holds a further navigation error, and is taken over other sums.
            let trace = |shape: &DMatrix<f64>| (0..3).map(|i| shape[(i, i)]).sum::<f64>();
            let ratio = (trace(&end.outer_shape) / trace(&planned.outer_shape)).sqrt();
            assert!((0.5..1.1).contains(&ratio), "{k}: {ratio}");
        }
        assert!(plan.coast(5).is_none());
        // Before any correction: the navigation error itself.
        let start = plan.coast(0).unwrap().at(Seconds::from_seconds(0.0)).outer_shape;
        let error = prisma().navigation_errors[0].shape().clone();
        assert!((start - &error).amax() < 1e-12 * error.amax());
    }
}
