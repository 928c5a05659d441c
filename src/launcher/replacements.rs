//! Handles controller programs that end before the run: restarts them or continues without them, as
//! configured in the scene.

use ipc_types::messages::{EventCode, Part as HubPart, Participant, Severity, Tick};
use ipc_types::ports::PortError;
use ipc_types::process::EventSender;
use ipc_types::scene::Controller;
use ipc_types::session::{Session, SessionError};

use super::hub::Hub;
use super::part::PartProcess;
use super::run::RunPlan;

/// Programs that have ended, and the report about each.
#[derive(Debug)]
pub(super) struct Replacements {
    events: EventSender,
    /// Parts that the run continues without.
    pub(super) gone: Vec<PartProcess>,
}

impl Replacements {
    pub(super) fn new(session: &Session) -> Result<Replacements, SessionError> {
        Ok(Replacements {
            events: EventSender::new(session, Participant::Part(HubPart::Host))?,
            gone: Vec::new(),
        })
    }

    /// Returns the program of this part and its restart count, if the run can continue without it.
    fn dispensable<'a>(
        &self,
        plan: &'a RunPlan,
        part: &PartProcess,
    ) -> Option<(&'a Controller, Vec<String>, u32)> {
        let controller = plan.scene.controller.iter().find(|controller| controller.name == part.name)?;
        let command = Hub::program_of(controller).ok()??;
        let before = self.gone.iter().filter(|gone| gone.name == part.name).count() as u32;
        (before < controller.restarts || controller.optional).then_some((controller, command, before))
    }

    /// Removes the part at this index after the end of the run. Returns false if the run could not have
    /// continued without it, in which case its exit status counts.
    pub(super) fn dismiss(&mut self, plan: &RunPlan, parts: &mut Vec<PartProcess>, index: usize) -> bool {
        let may_go = self.dispensable(plan, &parts[index]).is_some();
        if may_go {
            self.gone.push(parts.remove(index));
        }
        may_go
    }

    /// Restarts the part at this index, or removes it. Returns false if the run cannot continue without it.
    pub(super) fn replace(
        &mut self,
        plan: &RunPlan,
        hub: &Hub,
        parts: &mut Vec<PartProcess>,
        index: usize,
        tick: Tick,
    ) -> Result<bool, PortError> {
        let part = &mut parts[index];
        let Some((controller, command, before)) = self.dispensable(plan, part) else { return Ok(false) };
        let again = before < controller.restarts;
        let how = part.ended().map_or_else(String::new, |status| status.to_string());
        let words =
            part.last_words().pop().map_or_else(String::new, |line| format!(", last output `{line}`"));
        let then = match again {
            true => format!("restarting ({} of {})", before + 1, controller.restarts),
            false => "the run continues without it".to_owned(),
        };
        let text = format!("controller `{}` ended ({how}){words}; {then}", controller.name);
        self.events.send(tick, Severity::Warning, EventCode::Run, &text)?;
        if again {
            // If the program no longer exists, the run cannot replace it.
            let Ok(successor) = hub.start_program(&controller.name, &command) else { return Ok(false) };
            self.gone.push(std::mem::replace(part, successor));
        } else {
            self.gone.push(parts.remove(index));
        }
        Ok(true)
    }
}
