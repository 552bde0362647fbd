//! Where Sun and Moon are, and how they pull at a craft near the Earth.
//!
//! Positions come from the series that the IAU's SOFA collection publishes, in the crate
//! `sofars`: the Earth about the Sun by the simplified VSOP2000 (within 12 km of JPL's DE405), the
//! Moon by Meeus's shortened ELP 2000 (a few arc seconds, tens of km). Axes are those of the GCRS,
//! here taken for the inertial axes of the orbits. Terrestrial time stands for barycentric
//! dynamical time, 2 ms at most. Both bodies are where they are now, not where they are seen.

use hifitime::Epoch;
use nalgebra::{Vector3, Vector6};
use sofars::{
    consts::{DAU, DAYSEC, DJ00},
    eph,
};

use super::{hermite, two_body::stacked};

/// The Sun's gravitational parameter, m^3/s^2 (IAU 2015 nominal value).
pub(crate) const SUN_MU_M3_S2: f64 = 1.327_124_4e20;

/// The Moon's gravitational parameter, m^3/s^2 (JPL DE421).
pub(crate) const MOON_MU_M3_S2: f64 = 4.902_800_076e12;

/// Time between two tabulated positions. A cubic between them is off by `(w h)^4 r / 384`: 9 mm
/// for the Moon, less for the Sun.
const SPACING_S: f64 = 3600.0;

/// Sun and Moon over a stretch of time.
#[derive(Debug, Clone)]
pub(crate) struct SunAndMoon {
    /// Geocentric [position m, velocity m/s] of the Sun, then of the Moon, every [`SPACING_S`].
    rows: Vec<[Vector6<f64>; 2]>,
}

impl SunAndMoon {
    /// Tables both from `start` on, for `duration_s`; `None` outside the years 1900 to 2100, for
    /// which the series were made.
    pub(crate) fn new(start: Epoch, duration_s: f64) -> Option<Self> {
        let days = start.to_tt_since_j2k().to_seconds() / DAYSEC;
        let count = (duration_s / SPACING_S).ceil() as usize + 1;
        let rows = (0..=count).map(|row| at(days + row as f64 * SPACING_S / DAYSEC));
        Some(Self { rows: rows.collect::<Option<_>>()? })
    }

    /// Positions of Sun and Moon from the Earth's centre, m.
    pub(crate) fn positions_m(&self, time_s: f64) -> [Vector3<f64>; 2] {
        let row = ((time_s / SPACING_S).max(0.0) as usize).min(self.rows.len() - 2);
        let fraction = time_s / SPACING_S - row as f64;
        let (from, to) = (&self.rows[row], &self.rows[row + 1]);
        [0, 1].map(|body| hermite::cubic(&from[body], &to[body], SPACING_S, fraction))
    }
}

/// What Sun and Moon at `bodies` add to the acceleration of a craft at `position` from the Earth's
/// centre, m/s^2: their pull there less their pull at the Earth itself.
pub(super) fn tides(bodies: &[Vector3<f64>; 2], position: &Vector3<f64>) -> Vector3<f64> {
    let [sun, moon] = bodies;
    tide(SUN_MU_M3_S2, sun, position) + tide(MOON_MU_M3_S2, moon, position)
}

fn tide(mu: f64, body: &Vector3<f64>, position: &Vector3<f64>) -> Vector3<f64> {
    let towards = |from: &Vector3<f64>| {
        let way = body - from;
        way * (mu / way.norm().powi(3))
    };
    towards(position) - towards(&Vector3::zeros())
}

/// Geocentric states of Sun and Moon at days of terrestrial time since J2000.
fn at(days: f64) -> Option<[Vector6<f64>; 2]> {
    let (earth, _) = eph::epv00(DJ00, days)?;
    let metres = |[position, velocity]: [[f64; 3]; 2]| {
        let (p, v) = (Vector3::from(position), Vector3::from(velocity));
        stacked(&(p * DAU), &(v * (DAU / DAYSEC)))
    };
    Some([-metres(earth), metres(eph::moon98(DJ00, days))])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::EARTH_RADIUS_M;

    fn positions(date: &str) -> [Vector3<f64>; 2] {
        let start = date.parse().expect("a date");
        SunAndMoon::new(start, 0.0).expect("within 1900-2100").positions_m(0.0)
    }

    /// Ecliptic longitude and latitude of date, degrees, for a date at most decades from J2000.
    fn ecliptic_of_date(position: &Vector3<f64>, years_since_j2000: f64) -> (f64, f64) {
        let (s, c) = 23.439_291_f64.to_radians().sin_cos();
        let (y, z) = (position[1] * c + position[2] * s, position[2] * c - position[1] * s);
        // General precession in longitude, 50.29 arc seconds a year.
        let precession = 50.29 / 3600.0 * years_since_j2000;
        let longitude = y.atan2(position[0]).to_degrees() + precession;
        (longitude.rem_euclid(360.0), (z / position.norm()).asin().to_degrees())
    }

    /// Meeus, Astronomical Algorithms, example 47.a: the Moon on 1992 April 12, 0h dynamical time.
    #[test]
    fn moon_stands_where_meeus_has_it() {
        let [_, moon] = positions("1992-04-12T00:00:00 TT");
        // The printed distance has its last digit at 100 m; the crate's own series has the same.
        assert!((moon.norm() / 1e3 - 368_409.7).abs() < 0.1, "{} km", moon.norm() / 1e3);
        let (longitude, latitude) = ecliptic_of_date(&moon, -7.72);
        // 10 arc seconds: the ecliptic itself turns by 4 in these years, which is left out here.
        assert!((longitude - 133.162_655).abs() < 10.0 / 3600.0, "{longitude}");
        assert!((latitude + 3.229_126).abs() < 10.0 / 3600.0, "{latitude}");
    }

    /// Meeus, example 25.b: the Sun on 1992 October 13, 0h dynamical time, by the full VSOP87.
    #[test]
    fn sun_stands_where_meeus_has_it() {
        let [sun, _] = positions("1992-10-13T00:00:00 TT");
        assert!((sun.norm() / DAU - 0.997_608_53).abs() < 2e-7, "{} au", sun.norm() / DAU);
        let (longitude, latitude) = ecliptic_of_date(&sun, -7.22);
        assert!((longitude - (199.0 + 54.0 / 60.0 + 26.18 / 3600.0)).abs() < 10.0 / 3600.0);
        assert!(latitude.abs() < 5.0 / 3600.0, "{latitude}");
    }

    /// The total eclipse of 2024 April 8: NASA's catalogue has the Moon's shadow pass the Earth's
    /// centre at 0.3431 equatorial radii, greatest at 18:18:29 dynamical time.
    #[test]
    fn sun_and_moon_meet_at_a_known_eclipse() {
        let start = "2024-04-08T16:00:00 TT".parse().expect("a date");
        let bodies = SunAndMoon::new(start, 5.0 * 3600.0).expect("within 1900-2100");
        let shadow = |time: f64| {
            let [sun, moon] = bodies.positions_m(time);
            let axis = (moon - sun).normalize();
            (moon - axis * moon.dot(&axis)).norm() / EARTH_RADIUS_M
        };
        let least = (0..18_000).map(f64::from).min_by(|a, b| shadow(*a).total_cmp(&shadow(*b)));
        let least = least.expect("some second");
        // The Sun is seen 20 arc seconds from where it is now: 37 km at the Moon, 6e-3 radii, or
        // a minute of the Moon's motion.
        assert!((shadow(least) - 0.3431).abs() < 0.01, "{}", shadow(least));
        assert!((least - (2.0 * 3600.0 + 18.0 * 60.0 + 29.0)).abs() < 90.0, "{least}");
    }

    /// The table against the series themselves, half way between two rows.
    #[test]
    fn bodies_between_the_rows_of_their_table() {
        let start: Epoch = "2022-01-01T00:00:00 TT".parse().expect("a date");
        let bodies = SunAndMoon::new(start, 86_400.0).expect("within 1900-2100");
        let days = start.to_tt_since_j2k().to_seconds() / DAYSEC;
        for row in [0.5, 3.5, 20.5] {
            let time = row * SPACING_S;
            let exact = at(days + time / DAYSEC).expect("within 1900-2100");
            for (found, exact) in bodies.positions_m(time).iter().zip(exact) {
                let error = (found - exact.fixed_rows::<3>(0)).norm();
                // 9 mm, and the rounding of the date: 1e-12 days of 30 km/s is 3 mm.
                assert!(error < 0.05, "{error} m");
            }
        }
    }

    /// Far from the body the tide is `2 mu r / d^3` towards and away from it, half of that and
    /// inward across: in low orbit 1.5e-6 m/s^2 of the Moon on this day of a near perigee
    /// (358,000 km), 0.5e-6 of the Sun.
    #[test]
    fn tides_have_their_size() {
        let [sun, moon] = positions("2022-01-01T00:00:00 TT");
        for (mu, body, size) in [(MOON_MU_M3_S2, moon, 1.5e-6), (SUN_MU_M3_S2, sun, 5.8e-7)] {
            let towards = body.normalize();
            let across = towards.cross(&Vector3::z()).normalize();
            let strength = mu * 7e6 / body.norm().powi(3);
            // The next term of the series is 3 r / d of the strength: 6 % for the Moon.
            let along = tide(mu, &body, &(towards * 7e6));
            assert!((along - towards * (2.0 * strength)).norm() < 0.07 * strength);
            let sideways = tide(mu, &body, &(across * 7e6));
            assert!((sideways + across * strength).norm() < 0.07 * strength);
            assert!((2.0 * strength / size - 1.0).abs() < 0.05, "{strength}");
        }
    }

    #[test]
    fn bodies_outside_their_years_are_refused() {
        let start: Epoch = "2199-12-31T00:00:00 TT".parse().expect("a date");
        assert!(SunAndMoon::new(start, 3600.0).is_none());
    }
}
