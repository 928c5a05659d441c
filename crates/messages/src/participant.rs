//! Senders of events, and their numbers on the wire.

use crate::index::ControllerIndex;
use crate::part::Part;

/// A sender of events.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Participant {
    /// A part of the session.
    Part(Part),
    /// A controller of the scene.
    Controller(ControllerIndex),
}

/// [`Event::sender`](crate::Event::sender), [`Progress::consumer`](crate::Progress::consumer): the launcher.
pub const SENDER_LAUNCHER: u32 = Participant::Part(Part::Host).code();
/// The physics process.
pub const SENDER_PHYSICS: u32 = Participant::Part(Part::Physics).code();
/// The DRR process.
pub const SENDER_DRR: u32 = Participant::Part(Part::Drr).code();
/// The recorder process.
pub const SENDER_RECORDER: u32 = Participant::Part(Part::Recorder).code();
/// The scene's controller 0; controller i is `SENDER_CONTROLLER + i`.
pub const SENDER_CONTROLLER: u32 = 16;

const _: () = assert!(SENDER_RECORDER < SENDER_CONTROLLER && Part::ALL.len() <= SENDER_CONTROLLER as usize);

impl Participant {
    /// Returns the number on the wire.
    pub const fn code(self) -> u32 {
        match self {
            Participant::Part(part) => part as u32,
            Participant::Controller(index) => SENDER_CONTROLLER + index.0,
        }
    }

    /// Returns the sender with this number on the wire.
    pub fn of(number: u32) -> Option<Participant> {
        match number.checked_sub(SENDER_CONTROLLER) {
            Some(index) => Some(Participant::Controller(ControllerIndex(index))),
            None => Part::ALL.into_iter().find(|part| *part as u32 == number).map(Participant::Part),
        }
    }
}

/// The senders' constants, in the order of the client libraries' constants.
pub const SENDERS: &[(&str, u32)] = &[
    ("SENDER_LAUNCHER", SENDER_LAUNCHER),
    ("SENDER_PHYSICS", SENDER_PHYSICS),
    ("SENDER_DRR", SENDER_DRR),
    ("SENDER_RECORDER", SENDER_RECORDER),
    ("SENDER_CONTROLLER", SENDER_CONTROLLER),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Progress;

    #[test]
    fn every_part_and_controller_has_its_own_sender_code() {
        let codes: Vec<u32> = Part::ALL.map(|part| Participant::Part(part).code()).to_vec();
        assert_eq!(codes, [0, 1, 2, 3]);
        for number in (0..4).chain([16, 19]) {
            assert_eq!(Participant::of(number).map(Participant::code), Some(number));
        }
        assert_eq!(Participant::of(4), None);
        assert_eq!(Progress { consumer: 16, ..Progress::zeroed() }.consumer(), None);
    }
}
