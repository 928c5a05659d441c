//! `trabecula bridge`: connects a running session to other software.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use bridge_proc::igtl::{self, IgtlOptions, Permission, Where};
use clap::{ArgGroup, Args, Subcommand};
use foreign_text::foreign_path;
use ipc_types::process::EndRequest;
use ipc_types::text_file;

use crate::failure::Failure;

/// Port that OpenIGTLink is registered for.
const IGTL_PORT: u16 = 18944;

/// Bridges.
#[derive(Debug, Subcommand)]
pub enum BridgeCommand {
    /// OpenIGTLink, for 3D Slicer, PLUS and trackers: poses, tool, X-rays and figures out; plans, pauses and C-arm poses in.
    ///
    /// Positions are in RAS and millimetres, as Slicer takes them. docs/slicer.md lists the messages.
    Igtl(Box<IgtlArguments>),
}

/// Arguments of `bridge igtl`.
#[derive(Debug, Args)]
#[command(group(ArgGroup::new("permission").args(["control_token_file", "control_by_anyone"])))]
pub struct IgtlArguments {
    /// Folder of the session; without it this user's only running one.
    #[arg(long)]
    session: Option<String>,
    /// Controller of the scene (`external = true`) that the bridge is, so that peers can drive the arm; without it they only watch and
    /// steer the run.
    #[arg(long)]
    controller: Option<String>,
    /// Port to listen at; 0 takes a free one.
    #[arg(long, default_value_t = IGTL_PORT)]
    port: u16,
    /// Address to listen at. OpenIGTLink is not encrypted: beyond loopback everybody on the way reads and forges it.
    #[arg(long, default_value = "127.0.0.1")]
    bind: IpAddr,
    /// Connect to a server, such as Slicer's connector, instead of listening.
    #[arg(long, value_name = "ADDRESS:PORT", conflicts_with_all = ["port", "bind"])]
    connect: Option<SocketAddr>,
    /// Poses a second.
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    rate: f64,
    /// Let a peer control that has sent the first line of this file as a STRING named `Token`.
    #[arg(long, value_name = "FILE")]
    control_token_file: Option<PathBuf>,
    /// Let every peer control.
    #[arg(long)]
    control_by_anyone: bool,
    /// Speed of the arm to a plan's entry, in mm/s.
    #[arg(long, value_name = "MM_PER_S", default_value_t = 20.0)]
    approach: f64,
    /// Feed from a plan's entry to its target, in mm/s.
    #[arg(long, value_name = "MM_PER_S", default_value_t = 1.0)]
    feed: f64,
    /// Burr on the way to a plan's target, in turns a minute.
    #[arg(long, value_name = "RPM", default_value_t = 2250.0)]
    burr: f64,
}

/// Runs a bridge until the session ends or Ctrl-C.
///
/// # Errors
/// No session, a port in use, a value out of its range (2); the session's loss (1).
pub fn run(command: &BridgeCommand) -> Result<(), Failure> {
    let BridgeCommand::Igtl(arguments) = command;
    let options = arguments.options()?;
    let end = EndRequest::install()
        .map_err(|cause| Failure::failed(format!("signals cannot be handled: {cause}")))?;
    let ready = |address: Option<SocketAddr>| match address {
        Some(address) => say!("OpenIGTLink at {address}"),
        None => say!(
            "OpenIGTLink: connecting to {}",
            arguments.connect.map_or(String::new(), |to| to.to_string())
        ),
    };
    let done = igtl::serve(&options, &end, ready).map_err(|error| {
        if error.is_bad_input() { Failure::bad_input(&error) } else { Failure::failed(error.to_string()) }
    })?;
    say!(
        "{} peers; {} messages replaced by newer ones before a peer read them, {} of peers refused",
        done.peers,
        done.replaced,
        done.refused
    );
    Ok(())
}

impl IgtlArguments {
    fn options(&self) -> Result<IgtlOptions, Failure> {
        let peers = match self.connect {
            Some(address) => Where::Connect(address),
            None => Where::Listen(SocketAddr::new(self.bind, self.port)),
        };
        let permission = match &self.control_token_file {
            Some(file) => Permission::Token(token(file)?),
            None if self.control_by_anyone => Permission::Anyone,
            None => Permission::WatchOnly,
        };
        Ok(IgtlOptions {
            session: self.session.clone(),
            controller: self.controller.clone(),
            peers,
            permission,
            rate_hz: within("--rate", self.rate, 0.1, 1000.0)?,
            approach_m_per_s: within("--approach", self.approach, 0.01, 250.0)? / 1000.0,
            feed_m_per_s: within("--feed", self.feed, 0.01, 20.0)? / 1000.0,
            burr_rad_per_s: within("--burr", self.burr, 0.0, 60_000.0)? * core::f64::consts::PI / 30.0,
        })
    }
}

fn within(flag: &str, value: f64, least: f64, most: f64) -> Result<f64, Failure> {
    // Written so that NaN fails.
    if (least..=most).contains(&value) {
        return Ok(value);
    }
    Err(Failure::bad_input(format!("{flag}: {value}, expected {least} to {most}")))
}

fn token(file: &Path) -> Result<String, Failure> {
    let text = text_file::read(file)
        .map_err(|cause| Failure::bad_input(format!("{}: {cause}", foreign_path(file))))?;
    let token = text.lines().next().unwrap_or_default().trim();
    if token.len() < 8 {
        let file = foreign_path(file);
        return Err(Failure::bad_input(format!(
            "{file}: the first line is the token, at least 8 characters"
        )));
    }
    Ok(token.to_owned())
}
