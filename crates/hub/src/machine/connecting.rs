//! The start of a run: waits until all parts and required controllers are connected.

use messages::{ControllerIndex, Phase, Plant, Tick};

use super::control::StatusTiming;
use super::{
    CONNECT_LIMIT_NS, CONNECT_LOOK_NS, ControllerFault, Hub, HubError, NS_PER_S, Next, Outcome,
    SILENT_WAIT_NS, Stage, Step, WakeCondition, lane_failed, wait,
};
use crate::environment::Environment;
use crate::patience::ProcessTimeout;

impl<P: Plant> Hub<P> {
    /// Publishes the initial state until every part has answered it or the run is to end.
    pub(super) fn connect<E: Environment>(
        &mut self,
        env: &mut E,
        mut consumers: ProcessTimeout,
        mut controllers: Vec<ProcessTimeout>,
        mut notice: Option<ProcessTimeout>,
    ) -> Outcome<Step, P, E> {
        self.consumers.update(env)?;
        let missing = self.consumers.missing();
        if missing.is_none() && !self.shown {
            // Not before the consumers are connected, because they would miss the first messages.
            self.lane.begin(&self.plant, env).map_err(lane_failed(Tick::START))?;
            let now_ns = env.now_ns();
            self.after_state_published(env, now_ns);
            self.shown = true;
            let limit = |controller: &super::Controller| {
                ProcessTimeout::new(controller.connect_limit_ns, env.now_ns())
            };
            controllers.extend(self.controllers.iter().map(limit));
            notice = Some(ProcessTimeout::new(SILENT_WAIT_NS, env.now_ns()));
        }
        self.collect_commands(env)?;
        if self.ends(env) {
            return Ok((Stage::TickDue, None));
        }
        let now_ns = env.now_ns();
        match missing {
            Some(part) if consumers.is_over(now_ns) => {
                return Err(HubError::NotConnected { part, limit_s: CONNECT_LIMIT_NS / NS_PER_S });
            }
            Some(_) => {}
            None => {
                let over: Vec<bool> =
                    controllers.iter_mut().map(|patience| patience.is_over(now_ns)).collect();
                match self.awaited_controller() {
                    None => return self.connected(env),
                    Some(index) if over[index.slot()] => {
                        let controller = &self.controllers[index.slot()];
                        let limit_s = controller.connect_limit_ns / NS_PER_S;
                        let (name, refused) = (controller.name.clone(), controller.refused.clone());
                        let fault = ControllerFault::NotConnected { name, limit_s, refused };
                        return Err(HubError::Controller(fault));
                    }
                    Some(index) => {
                        let limit_ns = self.controllers[index.slot()].connect_limit_ns;
                        self.tell_if_long(env, &mut notice, index, ("first command", limit_ns), now_ns)?;
                    }
                }
            }
        }
        self.obey(env)?;
        self.send_status(env, Phase::Connecting, StatusTiming::IfDue)?;
        env.deliver_state_history()?;
        let until_ns = env.now_ns() + CONNECT_LOOK_NS;
        Ok((Stage::Connecting { consumers, controllers, notice }, wait(WakeCondition::Nothing, until_ns)))
    }

    fn connected<E: Environment>(&mut self, env: &mut E) -> Outcome<Step, P, E> {
        self.inform(env, "every part has connected")?;
        self.connected = true;
        self.send_status(env, self.phase(), StatusTiming::Now)?;
        Ok((Stage::Ready, Some(Next::GetReady)))
    }

    /// Returns a required controller that has not sent a command yet.
    fn awaited_controller(&self) -> Option<ControllerIndex> {
        let mut all = ControllerIndex::first(self.controllers.len());
        all.find(|index| !self.controllers[index.slot()].optional && !self.latch.has_command(*index))
    }
}
