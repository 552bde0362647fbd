//! Is there an abort? For one thrust mode: a sequence that keeps out of a polytope, or the proof
//! that there is none, or an honest "undecided".

use nalgebra::{SMatrix, Vector3};

use super::{
    clearance::Outside,
    flight::{Closest, Flight},
};
use crate::{
    budget::{Budget, Interruption},
    dynamics::{PeriodicPlant, RelativeVector},
    matrices::product_fixed,
    program::{CommonMargin, MarginAnswer},
    sets::Polytope,
};

/// An upper bound on a margin is believed to be negative beyond this part of a face's own scale:
/// rounding is below 1e-12.
const PROVED: f64 = 1e-9;

/// Asks for thrusts u_0 .. u_(N-1) of the working thrusters such that at every instant of the
/// horizon the state is outside the polytope, beyond at least one face by its clearance.
#[derive(Debug, Clone, Copy)]
pub struct AbortQuestion<'a> {
    /// The plant; its parts of steps are instants too.
    pub plant: &'a PeriodicPlant,
    /// The polytope of states to avoid, H x <= l.
    pub avoid: &'a Polytope,
    /// How far beyond a face the state must be to count as outside, one >= 0 a row, in the unit
    /// of the row.
    pub clearances: &'a [f64],
    /// Force of each thruster at full thrust, newtons, RTN.
    pub full_forces_n: &'a [Vector3<f64>],
    /// Bits of the working thrusters.
    pub working: u32,
    /// Index k of the state.
    pub start: usize,
    /// Safety horizon N, steps.
    pub horizon: usize,
    /// Most linear programs that the search may solve.
    pub programs_max: usize,
    /// Between the instants too: only a sequence that stays outside throughout is an answer.
    pub throughout: bool,
}

/// What is known about an abort.
#[derive(Debug, Clone, PartialEq)]
pub enum AbortVerdict {
    /// This one, verified by propagation.
    Found(Abort),
    /// None, proved: every way around the set was ruled out by a bound that holds for all
    /// thrusts.
    NoneProved {
        /// Linear programs solved.
        programs: usize,
    },
    /// The search was cut short; nothing is claimed.
    Undecided {
        /// Linear programs solved.
        programs: usize,
    },
}

/// An abort sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct Abort {
    /// Throttle of each thruster, 0 to 1, step by step up to the last that thrusts; failed ones
    /// are 0. Then the craft drifts.
    pub throttles: Vec<Vec<f64>>,
    /// The resulting forces, newtons, RTN, of the same steps.
    pub forces_n: Vec<Vector3<f64>>,
    /// Steps for which it was verified to keep out.
    pub horizon: usize,
    /// Where it leads, at every instant of the horizon.
    pub flight: Flight,
    /// Least over the instants of the largest excess over a face, in parts of that face's offset;
    /// of an ellipsoid, the gauge less 1.
    pub margin: f64,
    /// The same between the instants too: negative if a part of the region is crossed there.
    pub margin_throughout: f64,
    /// The closest moment to the target's centre of mass, between instants too; `least` is in
    /// square metres. Infinitely far for a flight without states.
    pub closest: Closest,
    /// Linear programs solved.
    pub programs: usize,
}

/// Searches for an abort.
///
/// "For all thrusts there is an instant inside" is the opposite of an abort, and it is not the
/// same as membership in a backward reachable set, "there is an instant such that for all
/// thrusts": proposition III.1 of [AguilarMarsillach2022] fails for active modes. So the question
/// is answered itself: outside at one instant means beyond one of the faces, and the choice of the
/// face is branched on. A node of the search has chosen faces for some instants; its linear
/// program asks for thrusts that go beyond all of them with the largest common margin. A negative
/// upper bound closes the node; thrusts that also clear every other instant are the answer; else
/// an instant that they do not clear is branched on, the one with the fewest faces in reach. If
/// the flight between instants counts, so are both ends of a segment that cuts a corner: beyond the
/// same face at both it does not.
///
/// # Errors
/// The [`Interruption`] of the budget, asked at every node.
pub fn find_abort(
    question: &AbortQuestion<'_>,
    x: &RelativeVector,
    budget: Budget<'_>,
) -> Result<AbortVerdict, Interruption> {
    budget.check()?;
    let search = Search::new(question, x);
    let idle = vec![0.0; search.variables()];
    let drift = search.fly(&idle);
    if search.inside(&drift).is_empty() {
        return Ok(AbortVerdict::Found(search.abort(&idle, drift, 0)));
    }
    search.run(budget)
}

/// The rows "beyond face r at instant t" over the throttles.
struct Search<'a> {
    question: &'a AbortQuestion<'a>,
    x: RelativeVector,
    working: Vec<usize>,
    outside: Outside,
    /// Scale of each face: margins are in parts of it.
    scales: Vec<f64>,
}

/// gains z - offset is the excess beyond a face, in parts of its scale.
#[derive(Clone)]
struct FaceRow {
    gains: Vec<f64>,
    offset: f64,
    /// Largest excess over all throttles.
    most: f64,
}

/// Faces chosen so far, with the answer of their program.
struct Node {
    chosen: Vec<(usize, usize)>,
    answer: MarginAnswer,
}

impl<'a> Search<'a> {
    fn new(question: &'a AbortQuestion<'a>, x: &RelativeVector) -> Self {
        let count = question.full_forces_n.len().min(32);
        let outside = Outside::new(question.avoid, question.clearances);
        Self {
            question,
            x: *x,
            working: (0..count).filter(|j| question.working >> j & 1 == 1).collect(),
            scales: outside.scales().collect(),
            outside,
        }
    }

    fn variables(&self) -> usize {
        self.question.horizon * self.working.len()
    }

    fn instants(&self) -> usize {
        self.question.horizon * self.question.plant.fraction_count() + 1
    }

    fn run(&self, budget: Budget<'_>) -> Result<AbortVerdict, Interruption> {
        let mut faces: Vec<Option<Vec<FaceRow>>> = vec![None; self.instants()];
        let mut programs = 0;
        let mut gaps = false;
        let empty = CommonMargin::new(self.variables()).solve(0.0, f64::INFINITY);
        let mut open = vec![Node { chosen: Vec::new(), answer: empty }];
        while let Some(node) = open.pop() {
            budget.check()?;
            let flight = self.fly(&node.answer.point);
            let inside = self.inside(&flight);
            if inside.is_empty() {
                return Ok(AbortVerdict::Found(self.abort(&node.answer.point, flight, programs)));
            }
            let Some((instant, reachable)) = self.branching(&inside, &node.chosen, &mut faces)
            else {
                // The program's own point does not clear what it was made to clear.
                gaps = true;
                continue;
            };
            if reachable.is_empty() {
                // In the set at this instant whatever is done: no choice elsewhere matters.
                return Ok(AbortVerdict::NoneProved { programs });
            }
            if programs + reachable.len() > self.question.programs_max {
                return Ok(AbortVerdict::Undecided { programs });
            }
            let mut children = Vec::new();
            for face in reachable {
                let mut chosen = node.chosen.clone();
                chosen.push((instant, face));
                let answer = self.solve(&chosen, &mut faces);
                programs += 1;
                if answer.bound < -PROVED {
                    continue;
                }
                if answer.margin < 0.0 {
                    gaps = true;
                    continue;
                }
                children.push(Node { chosen, answer });
            }
            // The most comfortable child is looked at first.
            children.sort_by(|a, b| a.answer.margin.total_cmp(&b.answer.margin));
            open.extend(children);
        }
        Ok(if gaps {
            AbortVerdict::Undecided { programs }
        } else {
            AbortVerdict::NoneProved { programs }
        })
    }

    /// The instant to branch on: of those inside and not yet chosen, the one with the fewest faces
    /// in reach, with these faces. `None` if all were chosen.
    fn branching(
        &self,
        inside: &[usize],
        chosen: &[(usize, usize)],
        faces: &mut [Option<Vec<FaceRow>>],
    ) -> Option<(usize, Vec<usize>)> {
        let mut best: Option<(usize, Vec<usize>)> = None;
        for &instant in inside {
            if chosen.iter().any(|&(other, _)| other == instant) {
                continue;
            }
            let rows = self.rows_at(instant, faces);
            let reachable: Vec<usize> =
                (0..rows.len()).filter(|&r| rows[r].most >= -PROVED).collect();
            if best.as_ref().is_none_or(|(_, fewest)| reachable.len() < fewest.len()) {
                best = Some((instant, reachable));
            }
        }
        best
    }

    fn solve(&self, chosen: &[(usize, usize)], faces: &mut [Option<Vec<FaceRow>>]) -> MarginAnswer {
        let mut program = CommonMargin::new(self.variables());
        for &(instant, face) in chosen {
            let row = &self.rows_at(instant, faces)[face];
            program.push(&row.gains, row.offset);
        }
        program.solve(-PROVED, f64::INFINITY)
    }

    fn rows_at<'f>(&self, instant: usize, faces: &'f mut [Option<Vec<FaceRow>>]) -> &'f [FaceRow] {
        faces[instant].get_or_insert_with(|| {
            (0..self.scales.len()).map(|face| self.face_row(instant, face)).collect()
        })
    }

    /// The excess beyond a face as a function of the throttles, by taking the face's normal back
    /// to the start.
    fn face_row(&self, instant: usize, face: usize) -> FaceRow {
        let question = self.question;
        let (plant, m) = (question.plant, self.working.len());
        let (steps, part) = (instant / plant.fraction_count(), instant % plant.fraction_count());
        let mut gains = vec![0.0; self.variables()];
        let mut normal: SMatrix<f64, 1, 6> =
            question.avoid.normals().row(face).fixed_columns::<6>(0).into_owned();
        let scale = self.scales[face];
        let mut back =
            |normal: &mut SMatrix<f64, 1, 6>, at: usize, step: &crate::dynamics::HeldStep| {
                let along = product_fixed(normal, &step.b);
                for (i, &j) in self.working.iter().enumerate() {
                    let force = &question.full_forces_n[j];
                    gains[at * m + i] = (0..3).map(|c| along[c] * force[c]).sum::<f64>() / scale;
                }
                *normal = product_fixed(normal, &step.a);
            };
        if part > 0 {
            back(&mut normal, steps, plant.fraction(question.start + steps, part));
        }
        for at in (0..steps).rev() {
            back(&mut normal, at, plant.step(question.start + at));
        }
        let drifted: f64 = (0..6).map(|c| normal[c] * self.x[c]).sum();
        let offset = (self.outside.limit(face) - drifted) / scale;
        let most = gains.iter().map(|g| g.max(0.0)).sum::<f64>() - offset;
        FaceRow { gains, offset, most }
    }

    fn forces(&self, throttles: &[f64]) -> Vec<Vector3<f64>> {
        let m = self.working.len();
        (0..self.question.horizon)
            .map(|step| {
                self.working.iter().enumerate().fold(Vector3::zeros(), |sum, (i, &j)| {
                    sum + self.question.full_forces_n[j] * throttles[step * m + i]
                })
            })
            .collect()
    }

    fn fly(&self, throttles: &[f64]) -> Flight {
        let forces = self.forces(throttles);
        Flight::under(self.question.plant, self.question.start, &self.x, &forces)
    }

    /// The instants at which the flight is not outside, and those beside such a moment.
    fn inside(&self, flight: &Flight) -> Vec<usize> {
        let states = flight.states();
        let mut inside: Vec<bool> =
            states.iter().map(|x| !(self.outside.excess(x) >= 0.0)).collect();
        if self.question.throughout {
            for i in 1..states.len() {
                let (from, to) = (&states[i - 1], &states[i]);
                if !(self.outside.between(from, to, flight.spacing_s(), 0.0) >= 0.0) {
                    inside[i - 1] = true;
                    inside[i] = true;
                }
            }
        }
        (0..states.len()).filter(|&t| inside[t]).collect()
    }

    fn abort(&self, throttles: &[f64], flight: Flight, programs: usize) -> Abort {
        let m = self.working.len();
        let last = throttles.iter().rposition(|&throttle| throttle > 0.0);
        let steps = last.map_or(0, |last| last / m + 1);
        let mut all = vec![vec![0.0; self.question.full_forces_n.len()]; steps];
        for (step, row) in all.iter_mut().enumerate() {
            for (i, &j) in self.working.iter().enumerate() {
                row[j] = throttles[step * m + i];
            }
        }
        let mut forces_n = self.forces(throttles);
        forces_n.truncate(steps);
        Abort {
            throttles: all,
            forces_n,
            horizon: self.question.horizon,
            margin: self.outside.at_instants(&flight),
            margin_throughout: self.outside.throughout(&flight),
            closest: flight.closest_to_target(),
            flight,
            programs,
        }
    }
}
