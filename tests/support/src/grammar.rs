//! Checks the grammar that all commands share, using the command line's own description.

use clap::Command;

/// Calls `look` with each command that does something, and its path such as `log export`. Skips hidden
/// commands, the parts of a session (`proc`) and commands that only forward their arguments.
fn each(command: &Command, path: &str, forwarded: &[&str], look: &mut dyn FnMut(&str, &Command)) {
    let below: Vec<&Command> =
        command.get_subcommands().filter(|command| command.get_name() != "help").collect();
    if below.is_empty() {
        look(path, command);
    }
    for command in below {
        let name = command.get_name();
        if command.is_hide_set() || name == "proc" || forwarded.contains(&name) {
            continue;
        }
        each(command, format!("{path} {name}").trim_start(), forwarded, look);
    }
}

/// Asserts that each command's help ends with examples, which the command line accepts, and with the exit
/// codes.
///
/// # Panics
/// A command violates this.
pub fn assert_helpful(command_line: &Command, forwarded: &[&str]) {
    let mut count = 0;
    each(command_line, "", forwarded, &mut |path, command| {
        let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
        assert!(help.contains("Exit codes: 0 done"), "{path}: no exit codes");
        let lines =
            help.lines().skip_while(|line| *line != "Examples:").skip(1).take_while(|line| !line.is_empty());
        let lines: Vec<&str> = lines.map(str::trim).collect();
        assert!(!lines.is_empty(), "{path}: no examples");
        for line in lines {
            let words: Vec<&str> = line.split(' ').collect();
            let own = format!("{} {path}", command_line.get_name());
            assert!(line.starts_with(&own), "{path}: {line}");
            if let Err(error) = command_line.clone().try_get_matches_from(words) {
                panic!("{line}: {error}");
            }
        }
        count += 1;
    });
    assert!(count > 3, "{count} commands");
}

/// Asserts that outputs are named by `-o` and `--output`, and by no other argument.
///
/// # Panics
/// A command violates this.
pub fn assert_outputs(command_line: &Command) {
    each(command_line, "", &[], &mut |path, command| {
        for argument in command.get_arguments() {
            let id = argument.get_id().as_str();
            assert!(!["out", "record", "destination", "to_file"].contains(&id), "{path}: {id}");
            if id == "output" {
                assert_eq!(
                    (argument.get_short(), argument.get_long()),
                    (Some('o'), Some("output")),
                    "{path}"
                );
            }
        }
    });
}

/// Returns the commands without `--json`, in alphabetical order.
pub fn without_json(command_line: &Command, forwarded: &[&str]) -> Vec<String> {
    let mut found = Vec::new();
    each(command_line, "", forwarded, &mut |path, command| {
        if !command.get_arguments().any(|argument| argument.get_id() == "json") {
            found.push(path.to_owned());
        }
    });
    found.sort();
    found
}
