//! Controller programs that end before the run does: started again, or done without, where the scene says so.

use ipc_types::messages::{EVENT_RUN, SENDER_LAUNCHER, SEVERITY_WARNING};
use ipc_types::ports::PortError;
use ipc_types::process::EventSender;
use ipc_types::session::{Session, SessionError};

use super::hub::Hub;
use super::part::Part;
use super::run::RunPlan;

/// Who has ended, and how often it was replaced.
#[derive(Debug)]
pub(super) struct Understudies {
    events: EventSender,
    /// Parts that the run goes on without.
    pub(super) gone: Vec<Part>,
}

impl Understudies {
    pub(super) fn new(session: &Session) -> Result<Understudies, SessionError> {
        Ok(Understudies { events: EventSender::new(session, SENDER_LAUNCHER)?, gone: Vec::new() })
    }

    /// Replaces the part of this index, or takes it out. False if the run cannot go on without it.
    ///
    /// # Errors
    /// The transport's.
    pub(super) fn replace(
        &mut self,
        plan: &RunPlan,
        hub: &Hub,
        parts: &mut Vec<Part>,
        index: usize,
        tick: u64,
    ) -> Result<bool, PortError> {
        let part = &mut parts[index];
        let of_part = |controller: &&ipc_types::scene::Controller| controller.name == part.name;
        let Some(controller) = plan.scene.controller.iter().find(of_part) else { return Ok(false) };
        let Some(command) = &controller.command else { return Ok(false) };
        let before = self.gone.iter().filter(|gone| gone.name == part.name).count() as u32;
        let again = before < controller.restarts;
        if !again && !controller.optional {
            return Ok(false);
        }
        let how = part.ended().map_or_else(String::new, |status| status.to_string());
        let words = part.last_words().pop().map_or_else(String::new, |line| format!(", saying `{line}`"));
        let then = match again {
            true => format!("start {} of {} follows", before + 1, controller.restarts),
            false => "the run goes on without it".to_owned(),
        };
        let text = format!("controller `{}` ended ({how}){words}; {then}", controller.name);
        self.events.send(tick, SEVERITY_WARNING, EVENT_RUN, &text)?;
        if again {
            // A program that is no longer there ends the run as one that cannot be replaced.
            let Ok(successor) = hub.start_program(&controller.name, command) else { return Ok(false) };
            self.gone.push(std::mem::replace(part, successor));
        } else {
            self.gone.push(parts.remove(index));
        }
        Ok(true)
    }
}
