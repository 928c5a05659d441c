//! Standard output for people: whoever reads it may have had enough (`| head`), which is no failure.

/// As `println!`, but a closed pipe ends nothing.
macro_rules! say {
    ($($arguments:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($arguments)*);
    }};
}
