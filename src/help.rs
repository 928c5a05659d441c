//! What every `--help` ends with: examples and exit codes. Both programs' command lines are completed here,
//! so that no command is without.

use clap::Command;

use crate::program::EXIT_CODES;

/// The examples of `trabecula`, one command line a line.
pub const EXAMPLES: &str = include_str!("examples.txt");

/// The command line with exit codes in the help of each of its commands, and those of the `examples`, one a
/// line, that call it.
pub fn completed(command: Command, examples: &str) -> Command {
    let program = command.get_name().to_owned();
    below(command.after_help(EXIT_CODES), &program, examples)
}

fn below(command: Command, path: &str, examples: &str) -> Command {
    command.mut_subcommands(|command| {
        let path = format!("{path} {}", command.get_name());
        let calls = |line: &&str| {
            line.strip_prefix(&path).is_some_and(|rest| rest.is_empty() || rest.starts_with(' '))
        };
        let lines: Vec<&str> =
            examples.lines().filter(calls).filter(|_| !command.has_subcommands()).collect();
        let text = match lines.as_slice() {
            [] => EXIT_CODES.to_owned(),
            lines => format!("Examples:\n  {}\n\n{EXIT_CODES}", lines.join("\n  ")),
        };
        below(command.after_help(text), &path, examples)
    })
}
