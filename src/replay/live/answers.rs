//! The controllers' logged replies.

use std::collections::BTreeMap;

use ipc_types::messages::{Command, CommandSource, ControllerIndex, DrrReply, Latched};
use recorder_proc::log_file::LogFile;
use run_log::{MessageStream, RunMode, Topic, command_topic};
use zerocopy::FromBytes;

use crate::failure::Failure;
use crate::replay::OpenedLog;

/// The controllers' logged replies.
pub(super) struct LoggedCommands {
    /// Per live controller, by the tick of the state that was answered.
    pub(super) expected: Vec<BTreeMap<u64, Command>>,
    /// By frame number.
    pub(super) replies: BTreeMap<u64, DrrReply>,
}

impl LoggedCommands {
    /// Reads the commands as sent if the log has a timing lane, because in real time not every command was
    /// latched, and a controller must see the same states as in the run. Otherwise reads the latched
    /// commands.
    pub(super) fn read(log: &OpenedLog, indices: &[ControllerIndex]) -> Result<LoggedCommands, Failure> {
        let mut expected = vec![BTreeMap::new(); indices.len()];
        let mut replies = BTreeMap::new();
        let mut stream = MessageStream::open(&LogFile::at(&log.path), log.options())?;
        let real_time = stream.header().mode == RunMode::RealTime;
        while let Ok(Some(message)) = stream.next_message() {
            if let (Some(Topic::Latched), Ok(latched)) =
                (message.known, Latched::read_from_bytes(message.body))
            {
                for (expected, index) in expected.iter_mut().zip(indices) {
                    let entry = &latched.commands[index.slot()];
                    if entry.source() == Ok(CommandSource::Fresh) {
                        expected.insert(entry.command.state_tick, entry.command);
                    }
                }
            }
            if let (Some(Topic::DrrReply), Ok(reply)) =
                (message.known, DrrReply::read_from_bytes(message.body))
            {
                replies.insert(reply.frame_sequence, reply);
            }
        }
        let mut answers = LoggedCommands { expected, replies };
        if real_time {
            answers.read_sent(log, indices);
        }
        Ok(answers)
    }

    fn read_sent(&mut self, log: &OpenedLog, indices: &[ControllerIndex]) {
        let timing = log.path.with_file_name("timing.mcap");
        let Ok(mut stream) = MessageStream::open(&LogFile::at(&timing), log.options()) else { return };
        let names = log.scene.controller_names();
        let topics: Vec<String> = indices.iter().map(|index| command_topic(&names[index.slot()])).collect();
        while let Ok(Some(message)) = stream.next_message() {
            let Some(live) = topics.iter().position(|topic| topic == message.topic) else { continue };
            if let Ok(command) = Command::read_from_bytes(message.body) {
                self.expected[live].entry(command.state_tick).or_insert(command);
            }
        }
    }
}
