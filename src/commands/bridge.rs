//! `trabecula bridge`: connects a running session to other software.

use std::net::{IpAddr, SocketAddr};
use std::path::{Path, PathBuf};

use bridge_proc::igtl::{self, IgtlOptions, PeerEndpoint, Permission};
use bridge_proc::ros2::{self, NetworkScope, Ready, Ros2Options};
use clap::{ArgGroup, Args, Subcommand};
use foreign_text::foreign_path;
use ipc_types::process::EndRequest;
use ipc_types::text_file;
use ros_interface::image::ImageForm;
use ros_interface::topics::Names;

use super::{Choice, choice};
use crate::failure::Failure;

/// Registered port of OpenIGTLink.
const IGTL_PORT: u16 = 18944;

/// Arguments of `bridge`.
#[derive(Debug, Subcommand)]
pub enum BridgeCommand {
    /// OpenIGTLink, for 3D Slicer, PLUS and trackers: sends poses, the tool, X-rays and measurements;
    /// receives plans, pauses and C-arm poses.
    ///
    /// Positions are RAS, in millimetres, as Slicer expects. docs/slicer.md lists the messages.
    Igtl(Box<IgtlArguments>),
    /// ROS 2 with CRTK topics: publishes states, transforms and X-rays; subscribes to servo and move
    /// commands. Needs no ROS installation.
    ///
    /// Stamps are simulated time, which is published on /clock. The frame `world` is the patient frame (LPS),
    /// in metres. docs/ros2.md lists the topics.
    Ros2(Box<Ros2Arguments>),
}

/// DDS discovery ranges, named as in ROS_AUTOMATIC_DISCOVERY_RANGE.
const RANGES: [Choice<NetworkScope>; 3] = [
    ("LOCALHOST", "This machine only", NetworkScope::Localhost),
    ("SUBNET", "All networks of this machine", NetworkScope::Subnet),
    ("SYSTEM_DEFAULT", "Same as LOCALHOST, the default of this bridge", NetworkScope::Localhost),
];

/// Arguments of `bridge ros2`.
#[derive(Debug, Args)]
pub struct Ros2Arguments {
    /// Folder of the session; default: this user's only running session.
    #[arg(long)]
    session: Option<String>,
    /// External controller of the scene (`external = true`) to act as, so that ROS 2 can send commands and
    /// pause the run; without it, the bridge only publishes.
    #[arg(long)]
    controller: Option<String>,
    /// DDS domain.
    #[arg(long, value_name = "N", env = "ROS_DOMAIN_ID", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=232))]
    domain_id: u16,
    /// Who can subscribe and, with --controller, send commands. DDS is not encrypted: beyond LOCALHOST,
    /// anyone on the network can.
    #[arg(
        long,
        value_name = "RANGE",
        env = "ROS_AUTOMATIC_DISCOVERY_RANGE",
        default_value = "LOCALHOST",
        ignore_case = true,
        value_parser = choice(&RANGES)
    )]
    discovery_range: NetworkScope,
    /// States per second.
    #[arg(long, value_name = "HZ", default_value_t = 100.0)]
    rate: f64,
    /// Exact runs: answer a state only once every part that the controller drives has a motion command whose
    /// header.stamp is the state's; publishes every state. Needs `run.mode = "lockstep"`.
    #[arg(long, requires = "controller", conflicts_with = "rate")]
    lockstep: bool,
    /// Name of the arm in topics and frames.
    #[arg(long, value_name = "NAME", default_value = "UR5")]
    arm: String,
    /// Name of the manipulator in topics and frames.
    #[arg(long, value_name = "NAME", default_value = "CM")]
    manipulator: String,
    /// Send X-rays at full resolution and 16 bits; Fast DDS subscribers then need larger receive buffers
    /// (docs/ros2.md).
    #[arg(long)]
    full_images: bool,
}

/// Arguments of `bridge igtl`.
#[derive(Debug, Args)]
#[command(group(ArgGroup::new("permission").args(["control_token_file", "control_by_anyone"])))]
pub struct IgtlArguments {
    /// Folder of the session; default: this user's only running session.
    #[arg(long)]
    session: Option<String>,
    /// External controller of the scene (`external = true`) to act as, so that peers can drive the arm;
    /// without it, they can watch, pause and image the run but not drive.
    #[arg(long)]
    controller: Option<String>,
    /// Port to listen on; 0 picks a free one.
    #[arg(long, default_value_t = IGTL_PORT)]
    port: u16,
    /// Address to listen on. OpenIGTLink is not encrypted: beyond loopback, anyone on the network path can
    /// read and forge messages.
    #[arg(long, default_value = "127.0.0.1")]
    bind: IpAddr,
    /// Connect to a server, such as Slicer's connector, instead of listening.
    #[arg(long, value_name = "ADDRESS:PORT", conflicts_with_all = ["port", "bind"])]
    connect: Option<SocketAddr>,
    /// Poses per second.
    #[arg(long, value_name = "HZ", default_value_t = 30.0)]
    rate: f64,
    /// Let peers control the run once they send the first line of this file as a STRING named `Token`.
    #[arg(long, value_name = "FILE")]
    control_token_file: Option<PathBuf>,
    /// Let every peer control the run.
    #[arg(long)]
    control_by_anyone: bool,
    /// Send peers nothing of the run, such as X-rays, before they have sent the token; without this, anyone
    /// who connects can watch.
    #[arg(long, requires = "control_token_file")]
    watch_with_token: bool,
    /// Speed of the arm to a plan's entry point, in mm/s.
    #[arg(long, value_name = "MM_PER_S", default_value_t = 20.0)]
    approach: f64,
    /// Feed rate from a plan's entry point to its target, in mm/s.
    #[arg(long, value_name = "MM_PER_S", default_value_t = 1.0)]
    feed: f64,
    /// Burr speed while drilling to a plan's target, in rpm.
    #[arg(long, value_name = "RPM", default_value_t = 2250.0)]
    burr: f64,
}

/// Runs a bridge until the session ends or Ctrl-C.
///
/// # Errors
/// No session, a port in use or a value out of range (2); a lost session (1).
pub fn run(command: &BridgeCommand) -> Result<(), Failure> {
    let end = EndRequest::install().map_err(Failure::signals)?;
    match command {
        BridgeCommand::Igtl(arguments) => igtl(arguments, &end),
        BridgeCommand::Ros2(arguments) => ros2(arguments, &end),
    }
}

fn igtl(arguments: &IgtlArguments, end: &EndRequest) -> Result<(), Failure> {
    let options = arguments.options()?;
    let ready = |address: Option<SocketAddr>| match address {
        Some(address) => say!("OpenIGTLink at {address}"),
        None => say!(
            "OpenIGTLink: connecting to {}",
            arguments.connect.map_or(String::new(), |to| to.to_string())
        ),
    };
    let done =
        igtl::serve(&options, end, ready).map_err(|error| Failure::by_kind(error.is_bad_input(), error))?;
    say!(
        "{} peers; {} outgoing messages superseded before a peer read them, {} incoming messages rejected",
        done.peers,
        done.replaced,
        done.refused
    );
    Ok(())
}

fn ros2(arguments: &Ros2Arguments, end: &EndRequest) -> Result<(), Failure> {
    let options = arguments.options()?;
    ros2::bound_memory();
    let ready = |ready: Ready| {
        let reach = match ready.is_closed {
            Some(true) => "this machine only",
            Some(false) => {
                "limited to this machine, but datagrams cannot be filtered here: block other hosts with a \
                 firewall"
            }
            None => "all networks of this machine",
        };
        let listens = match ready.listens {
            0 => "publishes only; --controller enables commands".to_owned(),
            count => format!("subscribed to {count} topics"),
        };
        say!("ROS 2 domain {}, {reach}; {listens}", options.domain_id);
    };
    let done = ros2::serve(&options, end, ready, |line| say!("{}", foreign_text::foreign_line(line)))
        .map_err(|error| Failure::by_kind(error.is_bad_input(), error))?;
    say!(
        "{} messages published, {} dropped for unresponsive subscribers; {} received, {} of them rejected; {} \
         lost on the network",
        done.published,
        done.left_out,
        done.received,
        done.refused,
        done.lost
    );
    let trips = &done.round_trips;
    if trips.count() > 0 {
        let [median_ms, p99_ms] = [0.5, 0.99].map(|share| trips.quantile_s(share) * 1e3);
        let (what, longest_ms) =
            (if options.lockstep { "answers" } else { "stamped commands" }, trips.longest_s() * 1e3);
        say!(
            "round trip from a state to its command: median {median_ms:.1} ms, p99 {p99_ms:.1} ms, longest \
             {longest_ms:.1} ms ({} {what})",
            trips.count()
        );
    }
    Ok(())
}

impl Ros2Arguments {
    fn options(&self) -> Result<Ros2Options, Failure> {
        let name = |flag: &str, name: &String| {
            if Names::is_legal(name) {
                return Ok(name.clone());
            }
            let expected = "a letter, then letters, digits and single underscores, at most 64";
            Err(Failure::bad_input(format!("{flag} is {}, expected {expected}", foreign_text::foreign(name))))
        };
        let names =
            Names { arm: name("--arm", &self.arm)?, manipulator: name("--manipulator", &self.manipulator)? };
        if names.arm == names.manipulator {
            return Err(Failure::bad_input(
                "--arm and --manipulator have the same name; expected two different names",
            ));
        }
        // The older variable overrides the range if set.
        let only_localhost = std::env::var_os("ROS_LOCALHOST_ONLY").is_some_and(|value| value == "1");
        let reach = match self.discovery_range {
            NetworkScope::Subnet if !only_localhost => NetworkScope::Subnet,
            _ => NetworkScope::Localhost,
        };
        Ok(Ros2Options {
            session: self.session.clone(),
            controller: self.controller.clone(),
            names,
            domain_id: self.domain_id,
            reach,
            rate_hz: within("--rate", self.rate, 0.1, 1000.0)?,
            image: if self.full_images { ImageForm::Full } else { ImageForm::Fitting },
            lockstep: self.lockstep,
        })
    }
}

impl IgtlArguments {
    fn options(&self) -> Result<IgtlOptions, Failure> {
        let peers = match self.connect {
            Some(address) => PeerEndpoint::Connect(address),
            None => PeerEndpoint::Listen(SocketAddr::new(self.bind, self.port)),
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
            watch_with_token: self.watch_with_token,
            rate_hz: within("--rate", self.rate, 0.1, 1000.0)?,
            approach_m_per_s: within("--approach", self.approach, 0.01, 250.0)? / 1000.0,
            feed_m_per_s: within("--feed", self.feed, 0.01, 20.0)? / 1000.0,
            burr_rad_per_s: within("--burr", self.burr, 0.0, 60_000.0)? * core::f64::consts::PI / 30.0,
        })
    }
}

fn within(flag: &str, value: f64, least: f64, most: f64) -> Result<f64, Failure> {
    // Written so that NaN is rejected.
    if (least..=most).contains(&value) {
        return Ok(value);
    }
    Err(Failure::bad_input(format!("{flag} is {value}; allowed: {least} to {most}")))
}

fn token(file: &Path) -> Result<String, Failure> {
    let text = text_file::read(file)
        .map_err(|cause| Failure::bad_input(format!("{}: {cause}", foreign_path(file))))?;
    let token = text.lines().next().unwrap_or_default().trim();
    if token.len() < 8 {
        let file = foreign_path(file);
        return Err(Failure::bad_input(format!(
            "{file}: the first line must be a token of at least 8 characters"
        )));
    }
    Ok(token.to_owned())
}
