//! Publishing keyframes: every so many ticks, from a buffer that is there from the start.

use ipc_types::messages::{EVENT_RUN, Keyframe, SEVERITY_WARNING};
use ipc_types::ports::{PortError, Publisher};
use ipc_types::process::EventSender;
use ipc_types::services::{KEYFRAME_PART_BYTES, MAX_KEYFRAME_BYTES};

use crate::simulation::Simulation;

/// The publisher of keyframes, and when they are due.
pub(super) struct Keyframes {
    publisher: Publisher<Keyframe>,
    period_ticks: u64,
    buffer: Vec<u8>,
    parts: u64,
    told: bool,
}

impl Keyframes {
    pub(super) fn new(publisher: Publisher<Keyframe>, period_ticks: u64) -> Keyframes {
        Keyframes { publisher, period_ticks, buffer: vec![0; MAX_KEYFRAME_BYTES], parts: 0, told: false }
    }

    /// Publishes the present state's keyframe if one is due. A state that does not fit has none, which is said once.
    pub(super) fn publish_due(
        &mut self,
        simulation: &Simulation<'_>,
        events: &mut EventSender,
    ) -> Result<(), PortError> {
        let state = simulation.state();
        if !state.tick.is_multiple_of(self.period_ticks) {
            return Ok(());
        }
        let length = match simulation.write_keyframe(&mut self.buffer) {
            Ok(length) => length,
            Err(_) if self.told => return Ok(()),
            Err(cause) => {
                self.told = true;
                let text = format!("no keyframe from tick {} on: {cause}", state.tick);
                return events.send(state.tick, SEVERITY_WARNING, EVENT_RUN, &text);
            }
        };
        for (index, part) in self.buffer[..length].chunks(KEYFRAME_PART_BYTES).enumerate() {
            self.parts += 1;
            let message = Keyframe {
                tick: state.tick,
                hash: state.hash,
                sequence: self.parts,
                total_bytes: length as u32,
                offset_bytes: (index * KEYFRAME_PART_BYTES) as u32,
                reserved: 0,
                data_length: part.len() as u32,
            };
            self.publisher.send_with_tail(&message, part)?;
        }
        Ok(())
    }
}
