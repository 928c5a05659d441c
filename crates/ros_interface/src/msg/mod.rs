//! The ROS 2 messages that the bridge exchanges, field by field as in their `.msg` files (Jazzy); their CDR
//! bytes match every ROS 2 since Humble.

mod control;
mod geometry;
mod sensor;
mod visualization;

pub use control::*;
pub use geometry::*;
pub use sensor::*;
pub use visualization::*;

use serde::{Deserialize, Serialize};

const NS_PER_S: u64 = 1_000_000_000;

/// `builtin_interfaces/msg/Time`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize)]
pub struct Time {
    /// Seconds.
    pub sec: i32,
    /// Nanoseconds after `sec`.
    pub nanosec: u32,
}

impl Time {
    /// Converts a simulated time, rounded to a nanosecond; out-of-range times are clamped.
    pub fn of_simulated(seconds: f64) -> Time {
        // Saturates, and NaN becomes 0.
        let ns = (seconds * NS_PER_S as f64).round() as u64;
        let sec = i32::try_from(ns / NS_PER_S).unwrap_or(i32::MAX);
        Time { sec, nanosec: (ns % NS_PER_S) as u32 }
    }

    /// Returns the time in nanoseconds; `None` if it is negative or not normalised.
    pub fn nanoseconds(self) -> Option<u64> {
        let sec = u64::try_from(self.sec).ok()?;
        let nanosec = u64::from(self.nanosec);
        (nanosec < NS_PER_S).then_some(sec * NS_PER_S + nanosec)
    }

    /// Returns the time in seconds.
    pub fn seconds(self) -> f64 {
        f64::from(self.sec) + f64::from(self.nanosec) / NS_PER_S as f64
    }
}

/// `std_msgs/msg/Header`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Header {
    /// Simulated time of what follows.
    pub stamp: Time,
    /// The frame in which the numbers are given.
    pub frame_id: String,
}

/// `rosgraph_msgs/msg/Clock`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Clock {
    /// Simulated time.
    pub clock: Time,
}

/// `std_msgs/msg/String`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Text {
    /// The text.
    pub data: String,
}

/// `std_msgs/msg/Float64`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Float64 {
    /// The number.
    pub data: f64,
}

/// `std_msgs/msg/UInt64`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct UInt64 {
    /// The number.
    pub data: u64,
}

/// `std_msgs/msg/Float64MultiArray`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Float64MultiArray {
    /// Arrangement of the numbers.
    pub layout: MultiArrayLayout,
    /// The numbers.
    pub data: Vec<f64>,
}

/// `std_msgs/msg/MultiArrayLayout`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MultiArrayLayout {
    /// Dimensions, the outermost first.
    pub dim: Vec<MultiArrayDimension>,
    /// Number of entries before the first.
    pub data_offset: u32,
}

/// `std_msgs/msg/MultiArrayDimension`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MultiArrayDimension {
    /// Its name.
    pub label: String,
    /// Number of entries.
    pub size: u32,
    /// Number of numbers in it.
    pub stride: u32,
}

impl Float64MultiArray {
    /// Returns a matrix; one of six rows has the linear rows first, then the angular ones.
    pub fn of_rows<const ROWS: usize>(rows: [Vec<f64>; ROWS]) -> Float64MultiArray {
        let columns = rows.first().map_or(0, Vec::len) as u32;
        let dimension = |label: &str, size, stride| MultiArrayDimension { label: label.into(), size, stride };
        let size = ROWS as u32;
        let dim = vec![dimension("rows", size, size * columns), dimension("columns", columns, columns)];
        Float64MultiArray { layout: MultiArrayLayout { dim, data_offset: 0 }, data: rows.concat() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tick_has_its_exact_stamp() {
        assert_eq!(Time::of_simulated(12.345), Time { sec: 12, nanosec: 345_000_000 });
        assert_eq!(Time::of_simulated(f64::NAN), Time::default());
        assert_eq!(Time::of_simulated(-1.0), Time::default());
        assert_eq!(Time::of_simulated(1e300).sec, i32::MAX);
    }
}
