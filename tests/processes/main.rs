//! The whole program, process by process: runs, replays, ends, bad input, foreign clients.
//!
//! Every test starts the built `trabecula` in its own folder with a scene that it writes itself. No test
//! asserts a wall-clock time; limits only keep a broken run from hanging the tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, missing_docs)]

mod answers;
mod anywhere;
mod attacked;
mod cache;
mod calibrate;
mod capacities;
mod clients;
#[allow(dead_code, reason = "other tests share it, too")]
mod common;
mod crash;
mod datasets;
mod described_files;
mod device;
#[allow(dead_code, reason = "the tests of volumes need more of it")]
#[path = "../../crates/volume_io/tests/common/dicom_bytes.rs"]
mod dicom_bytes;
mod doctor;
mod ends;
mod examples;
mod feasibility;
mod flight_recorder;
mod floods;
mod fmus;
mod forks;
mod frames;
mod gaps;
mod guided;
mod half_made;
mod held_back;
mod hostile;
mod identity;
mod inherited;
mod interrupts;
mod languages;
mod late_controllers;
mod lichtblick;
mod log_tools;
mod lost_tool;
mod memory;
mod model_validity;
mod oblique;
mod openigtlink;
mod orphans;
mod outputs;
mod plan;
mod plan_pages;
mod plan_paths;
mod plans;
mod predictions;
mod programs;
mod promise;
mod python;
mod readmes;
mod redirect_file;
mod replay;
mod restarts;
mod returning;
mod ros2;
mod run_control;
mod runs;
mod scene_show;
mod schedules;
mod security;
mod sent;
mod session_commands;
mod sessions;
mod slices;
mod stalled_recorder;
mod strays;
mod stress;
mod structures;
mod survival;
mod suspended;
mod sweeps;
mod terminal;
mod tip_jacobian;
mod tools;
mod truth;
mod unread;
mod untrusted;
mod unwritable;
mod versions;
mod view;
mod wheel;
