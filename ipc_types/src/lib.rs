//! Messages, service names, ports, tick protocol and scene files: what every process of the hub shares.

mod client;
pub mod command_check;
pub mod layout;
pub mod messages;
pub mod ports;
pub mod process;
pub mod reference;
pub mod scene;
pub mod scene_reference;
pub mod services;
pub mod session;
pub mod wake;
