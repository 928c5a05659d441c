//! What the session's publishers send.

use std::time::{Duration, Instant};

use ipc_types::messages::{DrrRequest, DrrStatus};
use ros_interface::image;
use ros_interface::outgoing::{self, Outgoing};
use ros_interface::topics::{Input, Output};

use super::{Ros2Session, TURN};
use crate::newest_clearances;
use crate::ros2::node::Node;
use crate::ros2::notices::Notices;

/// How long the last images and clouds may wait for a subscriber that has no room for them.
const REST_LIMIT: Duration = Duration::from_secs(2);
/// How often an unchanged state, as in a pause, is sent again.
const REPEAT_PERIOD: Duration = Duration::from_secs(1);

impl Ros2Session {
    /// Publishes what has changed since the last call.
    pub(crate) fn publish(&mut self, node: &mut Node, notices: &mut Notices<impl FnMut(&str)>) {
        self.publish_bone(node, notices);
        let phase = self.phase();
        let (Some(robot), Some(state)) = (&self.robot, self.client.state()) else { return };
        let is_new =
            self.sent.is_none_or(|(tick, when)| tick != state.tick || when.elapsed() >= REPEAT_PERIOD);
        if is_new {
            node.publish(outgoing::of_state(robot, state));
            self.sent = Some((state.tick, Instant::now()));
        }
        let operating = outgoing::operating_state(phase, self.commander.is_disabled(), state);
        let told = (operating, outgoing::is_busy(state));
        if self.told != Some(told) {
            self.told = Some(told);
            node.publish(outgoing::of_operating_state(told.0, told.1, state));
        }
        if is_new && let Ok(Some(jacobian)) = self.client.tip_jacobian() {
            node.publish(outgoing::of_tip_jacobian(robot, jacobian));
        }
        self.clearances = newest_clearances(&mut self.client).or(self.clearances);
        if is_new && let Some(reading) = &self.clearances {
            node.publish(outgoing::of_clearances(&self.client.scene().structure, reading));
        }
        self.refuse_takes(node, notices);
        self.publish_image(node);
    }

    /// Publishes an image: the next one that was requested, otherwise the newest; older ones are of no use to
    /// a subscriber. Returns whether it was requested, so that more may wait: one at a time, as clouds.
    fn publish_image(&mut self, node: &mut Node) -> bool {
        let (mut next, mut is_requested) = (Vec::new(), false);
        let front_m = self.client.scene().manipulator.radii().cutter.front_radius_m();
        while !is_requested && let Ok(view) = self.client.wait_frame(0, Duration::ZERO) {
            is_requested = view.frame.request_id != 0;
            next = image::of_frame(view.frame, view.pixels, self.form, front_m);
        }
        node.publish(next);
        is_requested
    }

    /// Reports which of the X-rays asked for will not come.
    fn refuse_takes(&mut self, node: &mut Node, notices: &mut Notices<impl FnMut(&str)>) {
        let Some(own) = self.client.info().controller.as_ref().map(|(_, index)| *index) else { return };
        while let Ok(Some(reply)) = self.client.next_frame_reply() {
            let why = match reply.status() {
                _ if reply.requester != DrrRequest::requester_of(Some(own)) => continue,
                Ok(DrrStatus::Accepted) => continue,
                Ok(DrrStatus::Busy) => "too many X-rays are waiting",
                _ => "the renderer cannot take it",
            };
            self.refuse(Input::CArmTake, why, node, notices);
        }
    }

    /// Publishes removed voxels and the bone's surface, one message at a time: a burst of clouds would
    /// overflow the receive buffers of Fast DDS.
    fn publish_bone(&mut self, node: &mut Node, notices: &mut Notices<impl FnMut(&str)>) {
        let Some(bone) = &self.bone else { return };
        if node.subscribers(Output::RemovedPoints).0 {
            bone.send_all();
        }
        if let (_, Some(count)) = node.subscribers(Output::BoneSurface) {
            bone.set_surface_wanted(count > 0);
        }
        if let Some(cloud) = self.unsent.take() {
            if !node.offer(&cloud) {
                self.unsent = Some(cloud);
            }
            return;
        }
        match bone.next() {
            Some(Ok(messages)) => self.unsent = offer_all(node, messages),
            Some(Err(line)) => self.tell(&line, notices),
            None => {}
        }
    }

    /// Publishes the last images and clouds, once the run is over.
    pub(crate) fn publish_rest(&mut self, node: &mut Node, notices: &mut Notices<impl FnMut(&str)>) {
        let begun = Instant::now();
        while begun.elapsed() < REST_LIMIT && self.publish_image(node) {
            std::thread::sleep(TURN);
        }
        let Some(mut bone) = self.bone.take() else { return };
        let mut unsent = self.unsent.take();
        let mut rest = bone.rest();
        while begun.elapsed() < REST_LIMIT {
            if let Some(cloud) = unsent.take() {
                unsent = (!node.offer(&cloud)).then_some(cloud);
                std::thread::sleep(TURN);
                continue;
            }
            match rest.next() {
                Some(Ok(messages)) => unsent = offer_all(node, messages),
                Some(Err(line)) => {
                    notices.say(&line);
                }
                None => break,
            }
        }
        node.await_clouds();
    }
}

/// Publishes messages; returns the cloud for which there was no room.
fn offer_all(node: &mut Node, messages: Vec<Outgoing>) -> Option<Outgoing> {
    messages.into_iter().find(|message| !node.offer(message))
}
