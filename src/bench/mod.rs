//! What the hub costs: measurements that print tables. Times are facts about a machine, so nothing here asserts one.


mod machine;

pub mod overhead;
pub mod ping_pong;
mod samples;


use crate::failure::Failure;

/// An error that ends a measurement.
fn failed(cause: impl ToString) -> Failure {
    Failure::failed(cause.to_string())
}

/// Prints one line of a table.
fn row(name: &str, value: &str) {
    println!("{name:<46} {value}");
}
