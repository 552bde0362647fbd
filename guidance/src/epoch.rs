//! Moments, as labels: the mathematics counts seconds from a mission's start and only carries the
//! moment of that start on to documents that need it.

/// A moment, and the scale in which its owner tells it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Epoch {
    /// Nanoseconds of International Atomic Time since 2000-01-01T12:00:00 TAI.
    pub nanoseconds_since_j2000_tai: i64,
    /// The scale in which documents are to tell it.
    pub time_system: TimeSystem,
}

/// Scales of time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum TimeSystem {
    /// Coordinated universal time.
    Utc,
    /// International atomic time.
    Tai,
    /// Terrestrial time.
    Tt,
    /// Time of the GPS.
    Gps,
    /// Barycentric dynamical time.
    Tdb,
}
