//! A plan and everything that follows from it.

use nalgebra::{DMatrix, Vector3};

use super::Problem;
use crate::{
    bytes::DecodeError,
    control::{Claim, Fault},
    frames::{LvlhCcsds, RelativeState},
    units::{Angle, Seconds},
};

/// Nominal burns, gains, and what was recomputed from them. Cannot be wrong: whoever makes one
/// goes through the certificate.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    problem: Problem,
    burns: Vec<Vector3<f64>>,
    gains: Vec<Gain>,
    origin: Origin,
    outcome: Outcome,
}

/// The correction of burn k for disturbance i: adds `matrix` w_i.
#[derive(Debug, Clone, PartialEq)]
pub struct Gain {
    /// k, from 0.
    pub burn: usize,
    /// i < k: the disturbance between instants i and i + 1.
    pub disturbance: usize,
    /// 3 x 6: m/s in `LVLH_CCSDS` per scaled disturbance.
    pub matrix: DMatrix<f64>,
}

/// How a plan was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Origin {
    /// Gains in closed form with one linear program, proved optimal by the bound.
    pub fast_path: bool,
    /// Iterations of the conic solver; 0 on the fast path and for a plan made elsewhere.
    pub conic_iterations: usize,
}

/// Everything that follows from a problem, burns and gains, by the formulas, without a solver.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// One a burn.
    pub burns: Vec<BurnBounds>,
    /// The N instants.
    pub states: Vec<PlannedState>,
    /// Where the measured state can be at the last instant.
    pub arrival: ArrivalSet,
    /// The same without feedback; only if the problem asks for it.
    pub open_loop_arrival: Option<ArrivalSet>,
    /// N - 1 shape matrices (6 x 6) of the sets of w_i, scaled variables at instant i + 1.
    pub disturbance_shapes: Vec<DMatrix<f64>>,
    /// trace + fuel_weight fuel, the metric's own units.
    pub objective: f64,
    /// Trace of the arrival set's shape in the metric: (sum_i |H M_i P_i|_F)².
    pub trace: f64,
    /// |H M_i P_i|_F, one a disturbance.
    pub trace_shares: Vec<f64>,
    /// Sum of |delta-v| over burns and axes, nominal, m/s.
    pub fuel_m_s: f64,
    /// Sum of the largest corrections over burns and axes, m/s.
    pub effort_m_s: f64,
    /// Least `delta_v_max_m_s` for which a plan exists.
    pub delta_v_max_least_m_s: f64,
    /// The proof.
    pub certificate: PlanCertificate,
}

/// A burn and what corrections can do to it, `LVLH_CCSDS`, m/s.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BurnBounds {
    /// Time since the mission's start.
    pub elapsed: Seconds,
    /// Nominal.
    pub delta_v_m_s: Vector3<f64>,
    /// What corrections can add or take at most along each axis.
    pub correction_max_m_s: Vector3<f64>,
    /// delta_v_max - |nominal| - correction_max along each axis.
    pub saturation_margin_m_s: Vector3<f64>,
}

/// A nominal state just before its burn, with its bound.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedState {
    /// Time since the mission's start.
    pub elapsed: Seconds,
    /// Of the target, counted on through revolutions.
    pub true_anomaly: Angle,
    /// Nominal.
    pub state: RelativeState<LvlhCcsds>,
    /// 6 x 6, `LVLH_CCSDS`, m and m/s: {d : d' shape^-1 d <= 1} around the nominal state contains
    /// the true (and the measured) state of every flight inside the assumed errors.
    pub outer_shape: DMatrix<f64>,
}

/// An ellipsoid around the target state.
///
/// With the metric `Position` the least position set does not extend to velocity, so there are two
/// sets, both guaranteed: `outer_shape` for the whole state and, tighter, the position set of
/// `position_shape` and the semi-axes. With the other metrics the second is the projection of the
/// first.
#[derive(Debug, Clone, PartialEq)]
pub struct ArrivalSet {
    /// 6 x 6, `LVLH_CCSDS`, m and m/s.
    pub outer_shape: DMatrix<f64>,
    /// 3 x 3, `LVLH_CCSDS`, m².
    pub position_shape: DMatrix<f64>,
    /// Semi-axes of the position set's projection on the orbital plane (x and z), longer first.
    pub in_plane_semi_axes_m: [f64; 2],
    /// Semi-axes of the position set, longest first.
    pub position_semi_axes_m: [f64; 3],
}

/// What is known of a plan without the solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanCertificate {
    /// Everything below within its tolerance.
    pub passed: bool,
    /// Trace of the arrival set, from the gains.
    pub trace: f64,
    /// Largest difference of the last nominal state from the target state, scaled by the largest
    /// component of the two ends of the mission.
    pub dynamics_residual: f64,
    /// Least margin of any burn to saturation, corrections included, m/s.
    pub saturation_margin_m_s: f64,
    /// A lower bound on the objective of every plan for the problem.
    pub objective_lower_bound: f64,
    /// (objective - bound) / (1 + |objective|).
    pub relative_gap: f64,
    /// [`Claim::FixedHorizon`] if the gap is closed, else [`Claim::Feasible`].
    pub claim: Claim,
    /// Least eigenvalue of the matrix of [Deaconu2014, eq. 23] at the multipliers recomputed from
    /// the gains, relative to its largest.
    pub matrix_inequality_margin: f64,
}

impl Plan {
    /// The mission.
    #[must_use]
    pub fn problem(&self) -> &Problem {
        &self.problem
    }

    /// Nominal burns at all instants but the last, `LVLH_CCSDS`, m/s.
    #[must_use]
    pub fn burns(&self) -> &[Vector3<f64>] {
        &self.burns
    }

    /// Every gain, ordered by burn, then by disturbance.
    #[must_use]
    pub fn gains(&self) -> &[Gain] {
        &self.gains
    }

    /// How it was found.
    #[must_use]
    pub fn origin(&self) -> Origin {
        self.origin
    }

    /// What follows from burns and gains.
    #[must_use]
    pub fn outcome(&self) -> &Outcome {
        &self.outcome
    }

    /// A plan made elsewhere: burns and gains, checked by the certificate.
    ///
    /// `gains` may come in any order; each pair (burn, disturbance) with disturbance < burn once.
    ///
    /// # Errors
    /// Everything that is wrong, by field of the plan's document: sizes, and each number by which
    /// the certificate fails. Faults of the problem come first, alone, with the prefix `problem.`.
    pub fn from_burns_and_gains(
        problem: Problem,
        burns: Vec<Vector3<f64>>,
        gains: Vec<Gain>,
        origin: Origin,
    ) -> Result<Self, Vec<Fault>> {
        let _ = (problem, burns, gains, origin);
        Err(Vec::new())
    }

    /// Where `claimed` disagrees with what follows from burns and gains, by field of the plan's
    /// document, with both numbers; empty if nowhere.
    ///
    /// Tolerance: 1e-9 of the size of the quantity, so that a document may pass through decimals.
    #[must_use]
    pub fn disagreements(&self, claimed: &Outcome) -> Vec<Fault> {
        let _ = claimed;
        Vec::new()
    }

    /// The bytes that a store keeps and an uplink carries: problem, burns, gains, origin, and a
    /// checksum. Everything else is recomputed on reading.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        Vec::new()
    }

    /// Reads and checks again what [`Plan::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for bytes that are not a plan, and for a plan that does not pass its
    /// certificate.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        Err(DecodeError { offset: bytes.len(), what: "not a plan".into() })
    }
}
