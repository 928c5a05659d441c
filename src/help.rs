//! Appends examples and exit codes to every `--help`, for the command lines of both programs.

use clap::Command;

use crate::program::EXIT_CODES;

/// Examples for `trabecula`, one command per line.
pub const EXAMPLES: &str = include_str!("examples.txt");

/// Adds to the help of each command the exit codes and those `examples` (one per line) that call it.
pub fn completed(command: Command, examples: &str) -> Command {
    let program = command.get_name().to_owned();
    below(command.after_help(EXIT_CODES), &program, examples)
}

fn below(command: Command, path: &str, examples: &str) -> Command {
    command.mut_subcommands(|command| {
        let path = format!("{path} {}", command.get_name());
        let is_call = |path: &str, line: &str| {
            line.strip_prefix(path).is_some_and(|rest| rest.is_empty() || rest.starts_with(' '))
        };
        let below_it: Vec<String> =
            command.get_subcommands().map(|other| format!("{path} {}", other.get_name())).collect();
        let is_own = |line: &&str| is_call(&path, line) && !below_it.iter().any(|other| is_call(other, line));
        let lines: Vec<&str> = examples.lines().filter(is_own).collect();
        let text = match lines.as_slice() {
            [] => EXIT_CODES.to_owned(),
            lines => format!("Examples:\n  {}\n\n{EXIT_CODES}", lines.join("\n  ")),
        };
        below(command.after_help(text), &path, examples)
    })
}
