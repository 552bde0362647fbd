//! Shards travel: their bytes come back bit by bit, and nothing else is taken for one.

use std::fmt::Debug;

use vbar_guidance::{
    Budget,
    control::{
        Controller, Failure, PrepareError,
        abort_safe::AbortSafe,
        disturbance_feedback::DisturbanceFeedback,
        offline_sampling::{OfflineSampling, Problem as SamplingProblem, Redundancy, Scheme},
        variable_horizon::{Scheme as HorizonScheme, VariableHorizon},
    },
    reach::ReadError,
};

use crate::{
    abort_safe_loop::{eccentric, station},
    disturbance_feedback_laws::{prisma, simbol_x},
    double_integrator,
    laws::{DisturbanceLaw, example},
};

/// Lengths and places at which long bytes are tried, beside all near both ends.
const TRIED: usize = 100;

fn merged<C: Controller>(problem: &C::Problem, shards: Vec<C::Shard>) -> C::Artifact
where
    C::Artifact: Debug,
{
    C::merge(problem, shards, Budget::UNLIMITED).unwrap_or_else(|error| panic!("{error:?}"))
}

fn read<C: Controller>(problem: &C::Problem, bytes: &[u8]) -> C::Shard {
    C::shard_from_bytes(problem, bytes, Budget::UNLIMITED).unwrap_or_else(|fault| panic!("{fault}"))
}

fn refusal<C: Controller>(problem: &C::Problem, bytes: &[u8]) -> String {
    match C::shard_from_bytes(problem, bytes, Budget::UNLIMITED) {
        Ok(_) => panic!("{} bytes were taken for a shard", bytes.len()),
        Err(ReadError::Bytes(fault)) => fault.what,
        Err(ReadError::Interrupted(why)) => panic!("an unlimited budget said {why:?}"),
    }
}

/// Everything that holds for the shards of a problem; `other` differs from it. Returns how many.
fn check<C: Controller<Artifact: Debug + PartialEq, Shard: Clone + Debug + PartialEq>>(
    problem: &C::Problem,
    other: &C::Problem,
    to_bytes: impl Fn(&C::Artifact) -> Vec<u8>,
) -> usize {
    let count = C::shards(problem);
    let run = |shard| C::run_shard(problem, shard, Budget::UNLIMITED).unwrap();
    let shards: Vec<C::Shard> = (0..count).map(run).collect();
    let bytes: Vec<Vec<u8>> = shards.iter().map(|s| C::shard_to_bytes(problem, s)).collect();

    // Read back last to first, and computed last to first, as another machine may.
    let mut decoded: Vec<_> = bytes.iter().rev().map(|bytes| read::<C>(problem, bytes)).collect();
    decoded.reverse();
    assert_eq!(decoded, shards);
    let again: Vec<_> = decoded.iter().map(|s| C::shard_to_bytes(problem, s)).collect();
    assert!(again == bytes, "bytes of the same shards differ");
    let elsewhere = (0..count).rev().map(|i| C::shard_to_bytes(problem, &run(i)));
    let mut elsewhere: Vec<_> = elsewhere.collect();
    elsewhere.reverse();
    assert!(elsewhere == bytes, "the same shard was computed to other bytes");
    let whole = merged::<C>(problem, shards.clone());
    assert!(to_bytes(&merged::<C>(problem, decoded)) == to_bytes(&whole));

    for bytes in &bytes {
        check_refusals::<C>(problem, bytes);
        assert_eq!(refusal::<C>(other, bytes), "a shard of another problem");
    }
    if count > 1 {
        let mut twice = shards.clone();
        twice[count - 1] = shards[0].clone();
        let reversed = shards.iter().rev().cloned().collect();
        for wrong in [twice, reversed, shards[1..].to_vec(), Vec::new()] {
            match C::merge(problem, wrong, Budget::UNLIMITED) {
                Err(PrepareError::Failure(Failure::Numerical(why))) => {
                    assert_eq!(why, "shards are missing or out of order");
                }
                other => panic!("{other:?}"),
            }
        }
    }
    count
}

fn check_refusals<C: Controller>(problem: &C::Problem, bytes: &[u8]) {
    let spread = (bytes.len() / TRIED).max(1);
    let near_an_end = |place: &usize| *place < TRIED || bytes.len() - place < TRIED;
    let places = (0..bytes.len()).filter(|place| place % spread == 0 || near_an_end(place));
    let mut altered = bytes.to_vec();
    for place in places {
        refusal::<C>(problem, &bytes[..place]);
        // A shorter shard whose checksum is right is still no shard.
        refusal::<C>(problem, &sealed(&bytes[..place.min(bytes.len() - 5)]));
        altered[place] ^= 1 << (place % 8);
        refusal::<C>(problem, &altered);
        altered[place] = bytes[place];
    }
    let longer: Vec<u8> = bytes.iter().copied().chain([0]).collect();
    refusal::<C>(problem, &longer);
    assert!(
        refusal::<C>(problem, &sealed(&bytes[..bytes.len() - 4]).repeat(2)).contains("checksum")
    );

    // Lengths that nobody has, at every word, with a checksum that is right: an error, or a shard
    // whose own bytes these are; never memory for what is not there.
    let body = &bytes[..bytes.len() - 4];
    let words = (0..body.len().saturating_sub(8)).filter(|place| place % spread == 0);
    for place in words {
        for length in [u64::MAX, 49_999_999, 1 << 40] {
            let mut altered = body.to_vec();
            altered[place..place + 8].copy_from_slice(&length.to_le_bytes());
            let altered = sealed(&altered);
            if let Ok(shard) = C::shard_from_bytes(problem, &altered, Budget::UNLIMITED) {
                assert!(C::shard_to_bytes(problem, &shard) == altered, "byte {place}");
            }
        }
    }
}

/// CRC-32 as IEEE 802.3 has it, after the bytes it is of.
fn sealed(body: &[u8]) -> Vec<u8> {
    let register = body.iter().fold(u32::MAX, |register, &byte| {
        (0..8).fold(register ^ u32::from(byte), |register, _| {
            (register >> 1) ^ (0xEDB8_8320 * (register & 1))
        })
    });
    [body, &(!register).to_le_bytes()].concat()
}

#[test]
fn shards_of_variable_horizon_come_back_and_nothing_else_is_one() {
    for scheme in [HorizonScheme::AdaptiveTerminal, HorizonScheme::TubeOptimalControl] {
        let problem = example(scheme, DisturbanceLaw::Uniform).problem();
        let other = example(HorizonScheme::FixedTerminal, DisturbanceLaw::Uniform).problem();
        assert_eq!(check::<VariableHorizon>(&problem, &other, |made| made.to_bytes()), 1);
    }
}

#[test]
fn shards_of_disturbance_feedback_come_back_and_nothing_else_is_one() {
    let (problem, other) = (prisma(9000.0), simbol_x(9000.0));
    assert_eq!(check::<DisturbanceFeedback>(&problem, &other, |made| made.to_bytes()), 1);
}

#[test]
fn shards_of_abort_safety_come_back_and_nothing_else_is_one() {
    // Four phases on a circular orbit; one with fourteen blocks of starts on an elliptic one.
    let (circular, elliptic) = (station(60), eccentric(20));
    assert_eq!(check::<AbortSafe>(&circular, &elliptic, |made| made.to_bytes()), 3);
    assert_eq!(check::<AbortSafe>(&elliptic, &circular, |made| made.to_bytes()), 14);
}

#[test]
fn shards_of_offline_sampling_come_back_and_nothing_else_is_one() {
    let problem = double_integrator::problem();
    let other = SamplingProblem { seed: 12, ..problem.clone() };
    let scaled = SamplingProblem {
        redundancy: Redundancy::InnerScaled { epsilon: 0.02 },
        ..double_integrator::problem()
    };
    for problem in [&problem, &scaled] {
        assert!(check::<OfflineSampling>(problem, &other, |made| made.to_bytes()) > 10);
    }
    for scheme in [Scheme::LinearQuadratic, Scheme::TubeRobust] {
        let problem = SamplingProblem { scheme, ..problem.clone() };
        assert_eq!(check::<OfflineSampling>(&problem, &other, |made| made.to_bytes()), 1);
    }
}

#[test]
fn shard_of_another_method_is_refused() {
    let (plan, horizon) =
        (prisma(9000.0), example(HorizonScheme::FixedTerminal, DisturbanceLaw::None).problem());
    let shard = VariableHorizon::run_shard(&horizon, 0, Budget::UNLIMITED).unwrap();
    let bytes = VariableHorizon::shard_to_bytes(&horizon, &shard);
    assert_eq!(refusal::<DisturbanceFeedback>(&plan, &bytes), "a shard of another method");
}
