//! A plan: burns and gains with everything that follows from them, and its bytes.

use nalgebra::{DMatrix, DVector, Vector3};

use super::{
    ArrivalSet, Coast, Outcome, Problem, encoding,
    model::LinearModel,
    outcome::{gain_count, physical_values},
};
use crate::{
    budget::Budget,
    bytes::{DecodeError, Reader, Writer},
    control::{Fault, PrepareError, unread},
    reach::ReadError,
};

/// First bytes of a plan of this method, with the version of the layout.
const MAGIC: &[u8; 8] = b"vbarDF\x00\x01";

/// Two numbers are the same if they differ by less than this share of the quantity's size: a
/// document may have passed through decimals and other units.
const SAME: f64 = 1e-9;

/// Nominal burns and gains that passed their certificate, with all that was recomputed from them.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    problem: Problem,
    model: LinearModel,
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

/// How a plan was found; not checked, because nothing depends on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Origin {
    /// Gains in closed form with one linear program, proved optimal by the bound.
    pub fast_path: bool,
    /// Iterations of the conic solver; 0 on the fast path and for a plan made elsewhere.
    pub conic_iterations: usize,
}

impl Origin {
    /// Of a plan that was not computed here.
    pub const ELSEWHERE: Self = Self { fast_path: false, conic_iterations: 0 };
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

    pub(super) fn model(&self) -> &LinearModel {
        &self.model
    }

    /// The coast after burn `k`, until the next instant; `None` if there is no such burn.
    #[must_use]
    pub fn coast(&self, k: usize) -> Option<Coast> {
        let burn = self.burns.get(k)?;
        Some(Coast::new(
            &self.problem.orbit,
            &self.model,
            k,
            burn,
            &self.outcome.states,
            &self.gains,
        ))
    }

    /// A plan made elsewhere: burns and gains, checked by the certificate.
    ///
    /// `gains` may come in any order; each pair (burn, disturbance) with disturbance < burn once.
    ///
    /// # Errors
    /// Everything that is wrong, by field of the plan's document: sizes, and each number by which
    /// the certificate fails. Faults of the problem come first, alone, and begin with `problem.`.
    pub fn from_burns_and_gains(
        problem: Problem,
        burns: Vec<Vector3<f64>>,
        gains: Vec<Gain>,
        origin: Origin,
    ) -> Result<Self, Vec<Fault>> {
        let budget = Budget::UNLIMITED;
        Self::from_burns_and_gains_within(problem, burns, gains, origin, budget).map_err(|error| {
            match error {
                PrepareError::Faults(faults) => faults,
                other => unreachable!("a plan is right, or has faults: {other:?}"),
            }
        })
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// [`PrepareError::Faults`] as there; [`PrepareError::Failure`] when interrupted.
    pub fn from_burns_and_gains_within(
        problem: Problem,
        mut burns: Vec<Vector3<f64>>,
        mut gains: Vec<Gain>,
        origin: Origin,
        budget: Budget<'_>,
    ) -> Result<Self, PrepareError> {
        let of_problem =
            |fault: Fault| Fault { field: format!("problem.{}", fault.field), ..fault };
        let faults = problem.faults();
        if !faults.is_empty() {
            return Err(PrepareError::Faults(faults.into_iter().map(of_problem).collect()));
        }
        let faults = size_faults(problem.instants.count() - 1, &burns, &gains);
        if !faults.is_empty() {
            return Err(PrepareError::Faults(faults));
        }
        budget.check()?;
        let model = LinearModel::new(&problem).map_err(|rounding| {
            let expected = "sets that survive scaling";
            let fault = Fault::new("problem.navigation_errors", expected, rounding);
            PrepareError::Faults(vec![fault])
        })?;
        gains.sort_by_key(|gain| (gain.burn, gain.disturbance));
        // The bytes know one zero: a plan that was just made is shown as one that was kept.
        let entries = gains.iter_mut().flat_map(|gain| gain.matrix.iter_mut());
        for x in entries.chain(burns.iter_mut().flatten()) {
            *x += 0.0;
        }
        let outcome = Outcome::new(&problem, &model, &burns, &gains, budget)?;
        let plan = Self { problem, model, burns, gains, origin, outcome };
        let faults = plan.outcome.certificate.faults(plan.model.limit);
        if faults.is_empty() { Ok(plan) } else { Err(PrepareError::Faults(faults)) }
    }

    /// Where `claimed` disagrees with what follows from burns and gains, by field of the plan's
    /// document, with both numbers; empty if nowhere.
    ///
    /// Numbers may differ by 1e-9 of the size of their quantity, no more: a document may have
    /// passed through decimals and other units.
    #[must_use]
    pub fn disagreements(&self, claimed: &Outcome) -> Vec<Fault> {
        let mut comparison = Comparison::default();
        let own = &self.outcome;
        comparison.outcome(own, claimed, self.model.limit);
        comparison.faults
    }

    /// The bytes that a store keeps and an uplink carries: problem, burns, gains, origin, and a
    /// checksum (CRC-32 of all bytes before it). Everything else is recomputed on reading.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut writer = Writer::default();
        writer.bytes(MAGIC);
        encoding::write_problem(&mut writer, &self.problem);
        self.write_found(&mut writer);
        writer.seal()
    }

    /// What was found for the problem: all that is not recomputed from it.
    pub(super) fn write_found(&self, writer: &mut Writer) {
        self.burns.iter().for_each(|burn| writer.vector3(burn));
        for gain in &self.gains {
            gain.matrix.iter().for_each(|&x| writer.number(x));
        }
        writer.tag(u8::from(self.origin.fast_path));
        writer.count(self.origin.conic_iterations);
    }

    /// Reads and checks again what [`Plan::to_bytes`] wrote.
    ///
    /// # Errors
    /// [`DecodeError`] for bytes that are not a plan, and for a plan that does not pass its
    /// certificate.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, DecodeError> {
        Self::from_bytes_within(bytes, Budget::UNLIMITED).map_err(ReadError::uninterrupted)
    }

    /// The same, if there is time.
    ///
    /// # Errors
    /// [`ReadError`].
    pub fn from_bytes_within(bytes: &[u8], budget: Budget<'_>) -> Result<Self, ReadError> {
        let mut reader = Reader::unsealed(bytes, || budget.check().map_err(ReadError::from))?;
        if reader.bytes()? != MAGIC {
            return Err(reader.fault("not a disturbance-feedback plan of this layout").into());
        }
        let problem = encoding::read_problem(&mut reader)?;
        let plan = Self::read_found(problem, &mut reader, budget)?;
        reader.end()?;
        Ok(plan)
    }

    /// Reads and checks again what [`Plan::write_found`] wrote.
    pub(super) fn read_found(
        problem: Problem,
        reader: &mut Reader<'_>,
        budget: Budget<'_>,
    ) -> Result<Self, ReadError> {
        let count = problem.instants.count() - 1;
        let burns = (0..count).map(|_| reader.vector3()).collect::<Result<Vec<_>, _>>()?;
        let mut gains = Vec::with_capacity(gain_count(count));
        for burn in 0..count {
            for disturbance in 0..burn {
                let entries = (0..18).map(|_| reader.number()).collect::<Result<Vec<_>, _>>()?;
                gains.push(Gain { burn, disturbance, matrix: DMatrix::from_vec(3, 6, entries) });
            }
        }
        let fast_path = match reader.tag()? {
            0 => false,
            1 => true,
            other => return Err(reader.fault(format!("origin {other} is not known")).into()),
        };
        let origin = Origin { fast_path, conic_iterations: reader.count()? };
        Self::from_burns_and_gains_within(problem, burns, gains, origin, budget)
            .map_err(|error| unread(error, reader))
    }
}

/// Wrong numbers of burns and gains, and entries that are not finite.
fn size_faults(count: usize, burns: &[Vector3<f64>], gains: &[Gain]) -> Vec<Fault> {
    let mut faults = Vec::new();
    if burns.len() != count {
        faults.push(Fault::new("burns", format!("{count} burns"), burns.len().to_string()));
    }
    for (k, burn) in burns.iter().enumerate() {
        if let Some(x) = burn.iter().find(|x| !x.is_finite()) {
            let field = format!("burns[{k}].delta_v_m_s");
            faults.push(Fault::new(field, "finite numbers", x.to_string()));
        }
    }
    let mut seen = vec![false; count * count];
    for (g, gain) in gains.iter().enumerate() {
        let (k, i) = (gain.burn, gain.disturbance);
        if k >= count || i >= k {
            let expected = format!("disturbance_index < burn_index < {count}");
            let got = format!("disturbance {i}, burn {k}");
            faults.push(Fault::new(format!("gains[{g}]"), expected, got));
        } else if std::mem::replace(&mut seen[k * count + i], true) {
            let got = format!("disturbance {i}, burn {k} again");
            faults.push(Fault::new(format!("gains[{g}]"), "each pair once", got));
        }
        if gain.matrix.shape() != (3, 6) {
            let (rows, columns) = gain.matrix.shape();
            let field = format!("gains[{g}].gain");
            faults.push(Fault::new(field, "3 x 6", format!("{rows} x {columns}")));
        } else if let Some(x) = gain.matrix.iter().find(|x| !x.is_finite()) {
            faults.push(Fault::new(format!("gains[{g}].gain"), "finite numbers", x.to_string()));
        }
    }
    if gains.len() != gain_count(count) {
        let expected = format!("{} gains, one a pair", gain_count(count));
        faults.push(Fault::new("gains", expected, gains.len().to_string()));
    }
    faults
}

/// Collects where two outcomes differ.
#[derive(Default)]
struct Comparison {
    faults: Vec<Fault>,
}

impl Comparison {
    fn outcome(&mut self, own: &Outcome, claimed: &Outcome, limit: f64) {
        self.number("objective", own.objective, claimed.objective, own.objective);
        self.number("trace", own.trace, claimed.trace, own.trace);
        self.number("fuel_m_s", own.fuel_m_s, claimed.fuel_m_s, limit);
        self.number(
            "diagnostics.delta_v_max_least_m_s",
            own.delta_v_max_least_m_s,
            claimed.delta_v_max_least_m_s,
            limit,
        );
        self.burns(own, claimed, limit);
        self.states(own, claimed);
        self.set("arrival", &own.arrival, &claimed.arrival);
        match (&own.open_loop_arrival, &claimed.open_loop_arrival) {
            (Some(own), Some(claimed)) => self.set("open_loop_arrival", own, claimed),
            (None, None) => {}
            (own, claimed) => {
                let said = |there: bool| if there { "present" } else { "absent" };
                let (own, claimed) = (said(own.is_some()), said(claimed.is_some()));
                self.faults.push(Fault::new("open_loop_arrival", own, claimed));
            }
        }
        let shapes = (own.disturbance_shapes.len(), claimed.disturbance_shapes.len());
        if self.same_count("disturbance_shapes_nd", shapes) {
            let pairs = own.disturbance_shapes.iter().zip(&claimed.disturbance_shapes);
            for (i, (own, claimed)) in pairs.enumerate() {
                self.shape(&format!("disturbance_shapes_nd[{i}]"), own, claimed);
            }
        }
        self.certificate(own, claimed, limit);
    }

    fn certificate(&mut self, own: &Outcome, claimed: &Outcome, limit: f64) {
        let (a, b) = (&own.certificate, &claimed.certificate);
        let objective = own.objective;
        self.number("certificate.trace", a.trace, b.trace, own.trace);
        self.number(
            "certificate.objective_lower_bound",
            a.objective_lower_bound,
            b.objective_lower_bound,
            objective,
        );
        for (field, own, claimed, size) in [
            ("relative_gap", a.relative_gap, b.relative_gap, 1.0),
            ("dynamics_residual_nd", a.dynamics_residual, b.dynamics_residual, 1.0),
            ("saturation_margin_m_s", a.saturation_margin_m_s, b.saturation_margin_m_s, limit),
            (
                "matrix_inequality_margin",
                a.matrix_inequality_margin,
                b.matrix_inequality_margin,
                1.0,
            ),
        ] {
            self.number(&format!("certificate.{field}"), own, claimed, size);
        }
        if a.passed != b.passed {
            let (own, claimed) = (a.passed.to_string(), b.passed.to_string());
            self.faults.push(Fault::new("certificate.passed", own, claimed));
        }
        if a.claim != b.claim {
            let (own, claimed) = (format!("{:?}", a.claim), format!("{:?}", b.claim));
            self.faults.push(Fault::new("certificate.optimality", own, claimed));
        }
    }

    fn burns(&mut self, own: &Outcome, claimed: &Outcome, limit: f64) {
        if !self.same_count("burns", (own.burns.len(), claimed.burns.len())) {
            return;
        }
        let duration = own.states.last().map_or(1.0, |last| last.elapsed.seconds());
        for (k, (a, b)) in own.burns.iter().zip(&claimed.burns).enumerate() {
            let field = |name: &str| format!("burns[{k}].{name}");
            let (own, said) = (a.elapsed.seconds(), b.elapsed.seconds());
            self.number(&field("elapsed_s"), own, said, duration);
            for (name, own, claimed) in [
                ("delta_v_m_s", a.delta_v_m_s, b.delta_v_m_s),
                ("correction_max_m_s", a.correction_max_m_s, b.correction_max_m_s),
                ("saturation_margin_m_s", a.saturation_margin_m_s, b.saturation_margin_m_s),
            ] {
                self.numbers(&field(name), own.as_slice(), claimed.as_slice(), limit);
            }
        }
    }

    fn states(&mut self, own: &Outcome, claimed: &Outcome) {
        if !self.same_count("states", (own.states.len(), claimed.states.len())) {
            return;
        }
        let duration = own.states.last().map_or(1.0, |last| last.elapsed.seconds());
        let mut sizes = DVector::zeros(6);
        for state in &own.states {
            sizes = sizes.zip_map(&physical_values(&state.state), |a: f64, b: f64| a.max(b.abs()));
        }
        let (length, speed) = (sizes.rows(0, 3).amax(), sizes.rows(3, 3).amax());
        for (k, (a, b)) in own.states.iter().zip(&claimed.states).enumerate() {
            let field = |name: &str| format!("states[{k}].{name}");
            let (own, said) = (a.elapsed.seconds(), b.elapsed.seconds());
            self.number(&field("elapsed_s"), own, said, duration);
            let (own, said) = (a.true_anomaly.radians(), b.true_anomaly.radians());
            self.number(&field("true_anomaly_deg"), own, said, 1.0 + own.abs());
            let (own, said) = (physical_values(&a.state), physical_values(&b.state));
            let halves = [("position_m", 0, length), ("velocity_m_s", 3, speed)];
            for (part, first, size) in halves {
                let (own, said) = (&own.as_slice()[first..], &said.as_slice()[first..]);
                self.numbers(&field(&format!("state.{part}")), &own[..3], &said[..3], size);
            }
            self.shape(&field("outer_shape"), &a.outer_shape, &b.outer_shape);
        }
    }

    fn set(&mut self, field: &str, own: &ArrivalSet, claimed: &ArrivalSet) {
        self.shape(&format!("{field}.shape"), &own.outer_shape, &claimed.outer_shape);
        let size = own.position_semi_axes_m[0];
        self.numbers(
            &format!("{field}.in_plane_semi_axes_m"),
            &own.in_plane_semi_axes_m,
            &claimed.in_plane_semi_axes_m,
            size,
        );
        self.numbers(
            &format!("{field}.position_semi_axes_m"),
            &own.position_semi_axes_m,
            &claimed.position_semi_axes_m,
            size,
        );
    }

    /// Entry (i, j) of a shape is of the size sqrt(S_ii S_jj).
    fn shape(&mut self, field: &str, own: &DMatrix<f64>, claimed: &DMatrix<f64>) {
        if own.shape() != claimed.shape() {
            let said = |m: &DMatrix<f64>| format!("{} x {}", m.nrows(), m.ncols());
            self.faults.push(Fault::new(field, said(own), said(claimed)));
            return;
        }
        for i in 0..own.nrows() {
            for j in 0..own.ncols() {
                let size = (own[(i, i)] * own[(j, j)]).sqrt();
                self.number(&format!("{field}[{i}][{j}]"), own[(i, j)], claimed[(i, j)], size);
            }
        }
    }

    fn numbers(&mut self, field: &str, own: &[f64], claimed: &[f64], size: f64) {
        for (i, (own, claimed)) in own.iter().zip(claimed).enumerate() {
            self.number(&format!("{field}[{i}]"), *own, *claimed, size);
        }
    }

    fn number(&mut self, field: &str, own: f64, claimed: f64, size: f64) {
        // What is not a number disagrees with everything.
        if !((own - claimed).abs() <= SAME * size.abs()) {
            self.faults.push(Fault::new(field, format!("{own:?}"), format!("{claimed:?}")));
        }
    }

    fn same_count(&mut self, field: &str, (own, claimed): (usize, usize)) -> bool {
        if own != claimed {
            self.faults.push(Fault::new(field, own.to_string(), claimed.to_string()));
        }
        own == claimed
    }
}
