//! The subscriber's side, for measurements: receives everything that a bridge on this machine publishes.

use ros_interface::topics::{Names, OUTPUTS};
use rustdds::DomainParticipant;
use rustdds::no_key::SimpleDataReader;

use super::node::{DdsDomain, qos};
use super::payload::{CdrAdapter, ReceivedCdr};
use super::{NetworkScope, Ros2Error};

/// Subscriptions to every topic that a bridge publishes.
pub struct Listener {
    readers: Vec<SimpleDataReader<ReceivedCdr, CdrAdapter>>,
    // Declared last, so that it is dropped after everything that belongs to it.
    _participant: DomainParticipant,
}

impl Listener {
    /// Subscribes to the topics with these names in a domain, on this machine. `rate_hz` is that of the
    /// bridge's states.
    ///
    /// # Errors
    /// The domain cannot be joined.
    pub fn open(domain_id: u16, names: &Names, rate_hz: f64) -> Result<Listener, Ros2Error> {
        let place = DdsDomain::open(domain_id, NetworkScope::Localhost)?;
        let reader = |row: &ros_interface::topics::Row<_>| {
            place.reader(&row.dds_name(names), &row.dds_type(), &qos(row.qos, rate_hz))
        };
        let readers = OUTPUTS.iter().map(reader).collect::<Result<_, _>>()?;
        Ok(Listener { readers, _participant: place.participant })
    }

    /// Returns the size of the messages received since the last call, in bytes.
    pub fn take(&mut self) -> u64 {
        let mut bytes = 0;
        for reader in &self.readers {
            reader.drain_read_notifications();
            while let Ok(Some(came)) = reader.try_take_one() {
                bytes += came.sample.cdr.len() as u64;
            }
        }
        bytes
    }
}

impl core::fmt::Debug for Listener {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Listener").field("topics", &self.readers.len()).finish_non_exhaustive()
    }
}
