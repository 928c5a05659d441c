//! Exact runs: which messages answer a state.
//!
//! A state is answered once each part that the controller drives has a motion command with the state's
//! stamp. The first one of a part counts, so the order in which topics arrive, repetitions and delays change
//! nothing.

use scene::Drives;
use thiserror::Error;

use crate::msg::Time;
use crate::topics::{INPUTS, Input};

/// Why a motion command answers no state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum StampError {
    /// No state with its stamp has been published.
    #[error(
        "header.stamp {}.{:09}: not that of the newest state, {}.{:09}",
        given.sec, given.nanosec, newest.sec, newest.nanosec
    )]
    Unknown {
        /// The message's stamp.
        given: Time,
        /// That of the state.
        newest: Time,
    },
}

/// How a motion command relates to the state that waits for an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Answer {
    /// The first command of its part for this state.
    First,
    /// Its part has answered this state already, or it answers an earlier one.
    Repeated,
}

/// The answers to one state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lockstep {
    stamp: Time,
    dt_ns: u64,
    /// Parts that the controller drives, and whether they have answered.
    parts: Vec<(Drives, bool)>,
}

impl Lockstep {
    /// Returns the exchange of a controller that drives these parts, with a state every `dt_ns`; `None` if no
    /// topic commands any of them.
    pub fn new(drives: &[Drives], dt_ns: u64) -> Option<Lockstep> {
        let has_topic = |part: &&Drives| INPUTS.iter().any(|row| row.topic.needs() == Some(**part));
        let parts: Vec<_> = drives.iter().filter(has_topic).map(|part| (*part, false)).collect();
        (!parts.is_empty()).then_some(Lockstep { stamp: Time::default(), dt_ns, parts })
    }

    /// Begins to wait for the answers to a state.
    pub fn begin(&mut self, stamp: Time) {
        self.stamp = stamp;
        self.parts.iter_mut().for_each(|(_, has_answered)| *has_answered = false);
    }

    /// Counts a motion command.
    ///
    /// # Errors
    /// Its stamp is not one of a published state.
    pub fn answer(&mut self, topic: Input, stamp: Time) -> Result<Answer, StampError> {
        // A stamp of zero is that of the first state, or missing.
        let is_of_a_state = stamp.nanoseconds().is_some_and(|ns| ns.is_multiple_of(self.dt_ns));
        if !is_of_a_state || stamp > self.stamp || (stamp == Time::default() && self.stamp != stamp) {
            return Err(StampError::Unknown { given: stamp, newest: self.stamp });
        }
        let part = self.parts.iter_mut().find(|(part, _)| topic.needs() == Some(*part));
        match part {
            Some((_, has_answered)) if stamp == self.stamp && !*has_answered => {
                *has_answered = true;
                Ok(Answer::First)
            }
            _ => Ok(Answer::Repeated),
        }
    }

    /// Returns whether every part has answered.
    pub fn is_complete(&self) -> bool {
        self.parts.iter().all(|(_, has_answered)| *has_answered)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PARTS: [Drives; 3] = [Drives::Tendon, Drives::Arm, Drives::CArm];

    fn at(milliseconds: u32) -> Time {
        Time { sec: 1, nanosec: milliseconds * 1_000_000 }
    }

    #[test]
    fn a_state_is_answered_once_each_part_has_a_command_with_its_stamp_in_any_order() {
        for topics in [[Input::TendonServoJf, Input::ArmMoveCp], [Input::ArmServoJv, Input::TendonServoJv]] {
            let mut lockstep = Lockstep::new(&PARTS, 1_000_000).unwrap();
            lockstep.begin(at(5));
            assert_eq!(lockstep.answer(topics[0], at(5)), Ok(Answer::First));
            assert!(!lockstep.is_complete());
            assert_eq!(lockstep.answer(topics[0], at(5)), Ok(Answer::Repeated), "the first one counts");
            assert_eq!(lockstep.answer(topics[1], at(4)), Ok(Answer::Repeated), "an earlier state's");
            assert!(!lockstep.is_complete());
            assert_eq!(lockstep.answer(topics[1], at(5)), Ok(Answer::First));
            assert!(lockstep.is_complete());
            lockstep.begin(at(6));
            assert!(!lockstep.is_complete());
        }
    }

    #[test]
    fn stamps_of_no_state_are_refused_and_parts_without_topics_do_not_count() {
        let mut lockstep = Lockstep::new(&PARTS, 1_000_000).unwrap();
        lockstep.begin(at(5));
        let rounded = Time { sec: 1, nanosec: 3_999_999 };
        let negative = Time { sec: -1, nanosec: 0 };
        let overflowed = Time { sec: 0, nanosec: 1_000_000_000 };
        for given in [at(6), Time::default(), rounded, negative, overflowed] {
            let refused = lockstep.answer(Input::TendonServoJf, given);
            assert_eq!(refused, Err(StampError::Unknown { given, newest: at(5) }));
        }
        let text = lockstep.answer(Input::ArmMoveJp, at(60)).unwrap_err().to_string();
        assert_eq!(text, "header.stamp 1.060000000: not that of the newest state, 1.005000000");
        lockstep.begin(Time::default());
        assert_eq!(
            lockstep.answer(Input::ArmMoveJp, Time::default()),
            Ok(Answer::First),
            "the first state's"
        );
        assert_eq!(Lockstep::new(&[Drives::CArm], 1_000_000), None);
    }
}
