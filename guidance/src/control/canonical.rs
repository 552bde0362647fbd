//! Canonical bytes of what problems of several methods hold.

use crate::{
    bytes::{DecodeError, Reader, Writer},
    epoch::{Epoch, TimeSystem},
};

pub(super) fn write_epoch(writer: &mut Writer, epoch: Epoch) {
    writer.integer(epoch.nanoseconds_since_j2000_tai);
    writer.tag(match epoch.time_system {
        TimeSystem::Utc => 1,
        TimeSystem::Tai => 2,
        TimeSystem::Tt => 3,
        TimeSystem::Gps => 4,
        TimeSystem::Tdb => 5,
    });
}

pub(super) fn read_epoch(reader: &mut Reader<'_>) -> Result<Epoch, DecodeError> {
    let nanoseconds_since_j2000_tai = reader.integer()?;
    let time_system = match reader.tag()? {
        1 => TimeSystem::Utc,
        2 => TimeSystem::Tai,
        3 => TimeSystem::Tt,
        4 => TimeSystem::Gps,
        5 => TimeSystem::Tdb,
        other => return Err(reader.unknown("time system", other)),
    };
    Ok(Epoch { nanoseconds_since_j2000_tai, time_system })
}
