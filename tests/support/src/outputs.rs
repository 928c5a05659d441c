//! Lists the commands that write files, using the command line's own description.

/// Returns the commands with an output and the argument that names it, such as `plot --output`, in
/// alphabetical order. Skips hidden commands and the parts of a session (`proc`).
pub fn outputs_of(command: &clap::Command) -> Vec<String> {
    let mut found = Vec::new();
    collect(command, "", &mut found);
    found.sort();
    found
}

fn collect(command: &clap::Command, path: &str, found: &mut Vec<String>) {
    for argument in command.get_arguments() {
        let id = argument.get_id().as_str();
        if ["output", "rungs"].contains(&id) {
            found.push(format!("{path}--{id}"));
        }
    }
    let of_users = |command: &&clap::Command| !command.is_hide_set() && command.get_name() != "proc";
    for command in command.get_subcommands().filter(of_users) {
        collect(command, &format!("{path}{} ", command.get_name()), found);
    }
}
