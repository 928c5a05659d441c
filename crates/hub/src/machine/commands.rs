//! Receives the controllers' commands.

use messages::services::COMMAND;
use messages::{ControllerIndex, EventCode, Plant, Severity};

use super::{Hub, MS, Outcome};
use crate::environment::{Environment, IncomingMessage, Note};
use crate::rate_limit::{Connection, WarningLimit};

/// The hub's view of one controller.
#[derive(Debug, Clone)]
pub(super) struct Controller {
    pub(super) name: String,
    /// Whether the run can start without it.
    pub(super) optional: bool,
    /// How long the start waits for it.
    pub(super) connect_limit_ns: u64,
    /// Time from publishing the newest state to the command that answers it; 0 until then.
    pub(super) round_trip_ns: u64,
    /// Sequence number of the newest command taken off the queue.
    seen_sequence: u64,
    /// Lost commands not yet reported.
    lost: u64,
    pub(super) warnings: WarningLimit,
    /// Why its newest command was refused; `None` if it was accepted.
    pub(super) refused: Option<String>,
    /// The newest command's connection.
    connection: Option<Connection>,
}

impl Controller {
    pub(super) fn new(controller: &scene::Controller) -> Controller {
        Controller {
            name: controller.name.clone(),
            optional: controller.optional,
            connect_limit_ns: (controller.connect_limit_s * 1e3) as u64 * MS,
            round_trip_ns: 0,
            seen_sequence: 0,
            lost: 0,
            warnings: WarningLimit::default(),
            refused: None,
            connection: None,
        }
    }
}

impl<P: Plant> Hub<P> {
    /// Takes the commands that have arrived. Invalid ones are refused, reported, and change nothing. Each
    /// call reads at most one queue length per controller and reports refusals together, so a flooding
    /// controller cannot stall the tick.
    pub(super) fn collect_commands<E: Environment>(&mut self, env: &mut E) -> Outcome<(), P, E> {
        for index in ControllerIndex::first(self.controllers.len()) {
            for _ in 0..COMMAND.queue_length {
                let Some(incoming) = env.receive_command(index)? else { break };
                let refused = self.offer(env, index, incoming);
                let controller = &mut self.controllers[index.slot()];
                controller.refused = refused;
                let Some(reason) = &controller.refused else { continue };
                self.refused_commands += 1;
                if controller.warnings.allows(env.now_ns()) {
                    let text = format!("{reason}; refused");
                    self.warn(env, index, EventCode::CommandRefused, &text)?;
                }
            }
            if let Some(more) = self.controllers[index.slot()].warnings.take_suppressed(|| env.now_ns()) {
                self.warn(env, index, EventCode::CommandRefused, &format!("{more} more commands refused"))?;
            }
            let controller = &mut self.controllers[index.slot()];
            if controller.lost > 0 && controller.warnings.allows(env.now_ns()) {
                let lost = std::mem::take(&mut controller.lost);
                let length = COMMAND.queue_length;
                let commands = if lost == 1 { "command" } else { "commands" };
                let text = format!(
                    "{lost} {commands} lost: the queue ({length}) overflowed, or sequence numbers were skipped"
                );
                self.warn(env, index, EventCode::MessagesLost, &text)?;
            }
        }
        Ok(())
    }

    /// Offers a command to the latch; returns the reason if the latch refuses it.
    fn offer<E: Environment>(
        &mut self,
        env: &E,
        index: ControllerIndex,
        incoming: IncomingMessage<messages::Command>,
    ) -> Option<String> {
        let (command, connection) = match incoming {
            IncomingMessage::Message(command, connection) => (command, connection),
            IncomingMessage::Malformed(reason) => return Some(reason),
        };
        let controller = &mut self.controllers[index.slot()];
        if controller.connection != Some(connection) {
            (controller.connection, controller.seen_sequence) = (Some(connection), 0);
            self.latch.connect(index);
        }
        if command.state_tick == self.tick.0 && controller.round_trip_ns == 0 {
            controller.round_trip_ns = env.now_ns().saturating_sub(self.published_ns).max(1);
        }
        let lost = overwritten(&mut controller.seen_sequence, command.sequence);
        controller.lost = controller.lost.saturating_add(lost);
        let outcome = self.latch.offer(index, &command, self.tick);
        outcome.err().map(|cause| format!("command {}: {cause}", command.sequence))
    }

    pub(super) fn warn<E: Environment>(
        &self,
        env: &mut E,
        controller: ControllerIndex,
        code: EventCode,
        text: &str,
    ) -> Outcome<(), P, E> {
        let text = format!("controller `{}`: {text}", self.controllers[controller.slot()].name);
        Ok(env.send_event(&Note { tick: self.tick, severity: Severity::Warning, code, text: &text })?)
    }
}

/// Returns the number of commands between the newest one seen and this one. Clients number their commands
/// without gaps, so these were overwritten.
fn overwritten(seen: &mut u64, sequence: u64) -> u64 {
    let gap = sequence.saturating_sub(seen.saturating_add(1));
    *seen = sequence.max(*seen);
    gap
}
