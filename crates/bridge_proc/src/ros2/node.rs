//! The bridge as a node of a DDS domain.

use std::collections::BTreeMap;

use ros_interface::cdr::{self, Order};
use ros_interface::msg::{Gid, NodeEntitiesInfo, ParticipantEntitiesInfo};
use ros_interface::outgoing::Outgoing;
use ros_interface::topics::{INPUTS, Input, OUTPUTS, Output, Qos};
use rustdds::no_key::{DataWriter, SimpleDataReader};
use rustdds::policy::{Durability, History, Reliability, ResourceLimits};
use rustdds::{
    DataReaderStatus, DataWriterStatus, DomainParticipant, DomainParticipantBuilder, Duration, GUID,
    Publisher, QosPolicies, QosPolicyBuilder, RTPSEntity, StatusEvented, Subscriber, Timestamp, Topic,
    TopicKind,
};

use super::loopback::Loopback;
use super::payload::{CdrAdapter, OutgoingCdr, ReceivedCdr};
use super::{NetworkScope, Ros2Error, Ros2Options, Summary};

/// The node's name, as `ros2 node list` shows it.
pub(crate) const NODE: &str = "trabecula_bridge";
/// Seconds of states queued for a subscriber that acknowledges none: longer than the lease after which Fast
/// DDS and Cyclone DDS drop a silent participant (20 s and 10 s), so that a stopped subscriber does not
/// affect the others.
const STATE_WINDOW_S: f64 = 30.0;
/// States per second for which queues are sized in lockstep.
const LOCKSTEP_HZ: f64 = 1000.0;
/// Number of images queued.
const IMAGE_WINDOW: i32 = 16;
/// Number of clouds queued; what has no room is sent later.
const CLOUD_WINDOW: i32 = 64;
/// How long the end waits for subscribers to acknowledge the last clouds.
const LAST_CLOUDS: std::time::Duration = std::time::Duration::from_secs(2);
/// Maximum number of messages of one topic processed in one turn.
const MOST_A_TURN: usize = 64;

type Writer = DataWriter<OutgoingCdr, CdrAdapter>;

/// An event of a subscription.
#[derive(Debug)]
pub(crate) enum Incoming {
    /// A message of a topic.
    Message { topic: Input, cdr: Vec<u8>, order: Order, from: GUID },
    /// A message that DDS could not deliver.
    Broken { topic: Input, why: String },
    /// A publisher with a lower quality of service than the bridge needs.
    Unfit { topic: Input },
    /// A publisher that has disconnected.
    Gone { from: GUID },
}

/// The node's publishers and subscriptions. Dropping it leaves the domain.
pub(crate) struct Node {
    writers: BTreeMap<Output, Writer>,
    /// Sequence number of the last message of each publisher.
    last: BTreeMap<GUID, i64>,
    readers: Vec<(Input, SimpleDataReader<ReceivedCdr, CdrAdapter>)>,
    /// Announces the node, for `ros2 node list`.
    _known: Writer,
    is_closed: Option<bool>,
    summary: Summary,
    // Declared last, so that it is dropped after everything that belongs to it.
    _participant: DomainParticipant,
}

impl Node {
    pub(crate) fn open(options: &Ros2Options, inputs: &[Input]) -> Result<Node, Ros2Error> {
        let place = DdsDomain::open(options.domain_id, options.reach)?;
        // In lockstep, states follow each other faster than at any rate.
        let rate_hz = if options.lockstep { LOCKSTEP_HZ } else { options.rate_hz };
        let mut writers = BTreeMap::new();
        for row in OUTPUTS {
            let (name, kind) = (row.dds_name(&options.names), row.dds_type());
            writers.insert(row.topic, place.writer(&name, &kind, &qos(row.qos, rate_hz))?);
        }
        let mut readers = Vec::new();
        for row in INPUTS.iter().filter(|row| inputs.contains(&row.topic)) {
            let (name, kind) = (row.dds_name(&options.names), row.dds_type());
            readers.push((row.topic, place.reader(&name, &kind, &qos(row.qos, rate_hz))?));
        }
        let known = place.make_known(&writers, &readers)?;
        let is_closed = place.close_again();
        let summary = Summary::default();
        let last = BTreeMap::new();
        Ok(Node {
            writers,
            last,
            readers,
            _known: known,
            is_closed,
            summary,
            _participant: place.participant,
        })
    }

    /// Whether the operating system keeps other machines out, if that was requested.
    pub(crate) fn is_closed(&self) -> Option<bool> {
        self.is_closed
    }

    pub(crate) fn listens(&self) -> usize {
        self.readers.len()
    }

    /// Publishes messages; a message for which there is no room is skipped, never waited for.
    pub(crate) fn publish(&mut self, messages: Vec<Outgoing>) {
        for message in messages {
            let Some(writer) = self.writers.get(&message.topic) else { continue };
            match writer.write(OutgoingCdr(message.cdr.into()), Some(Timestamp::now())) {
                Ok(()) => self.summary.published += 1,
                Err(_) => self.summary.left_out += 1,
            }
        }
    }

    /// Publishes a message that must not be skipped. Returns false if there is no room for it yet.
    pub(crate) fn offer(&mut self, message: &Outgoing) -> bool {
        let Some(writer) = self.writers.get(&message.topic) else { return true };
        let is_sent = writer.write(OutgoingCdr(message.cdr.clone().into()), Some(Timestamp::now())).is_ok();
        self.summary.published += u64::from(is_sent);
        is_sent
    }

    /// Returns whether a subscriber of a topic has joined since the last call, and the number of subscribers
    /// if it has changed.
    pub(crate) fn subscribers(&self, topic: Output) -> (bool, Option<i32>) {
        let (mut has_joined, mut count) = (false, None);
        while let Some(status) = self.writers.get(&topic).and_then(StatusEvented::try_recv_status) {
            if let DataWriterStatus::PublicationMatched { current, .. } = status {
                has_joined |= current.count_change() > 0;
                count = Some(current.count());
            }
        }
        (has_joined, count)
    }

    /// Waits until every subscriber has the last clouds, for a limited time.
    pub(crate) fn await_clouds(&self) {
        if let Some(writer) = self.writers.get(&Output::RemovedPoints) {
            let _ = writer.wait_for_acknowledgments(LAST_CLOUDS);
        }
    }

    /// Returns everything received since the last call.
    pub(crate) fn take(&mut self) -> Vec<Incoming> {
        let mut all = Vec::new();
        let mut arrived = Vec::new();
        for (topic, reader) in &self.readers {
            let topic = *topic;
            reader.drain_read_notifications();
            for _ in 0..MOST_A_TURN {
                match reader.try_take_one() {
                    Ok(None) => break,
                    Ok(Some(came)) => {
                        let number = i64::from(came.sequence_number);
                        if let Some(before) = self.last.insert(came.writer_guid, number) {
                            self.summary.lost += u64::try_from(number - before - 1).unwrap_or(0);
                        }
                        let ReceivedCdr { cdr, order } = came.sample;
                        let message = Incoming::Message { topic, cdr, order, from: came.writer_guid };
                        arrived.push((came.receive_instant, message));
                    }
                    Err(error) => all.push(Incoming::Broken { topic, why: error.to_string() }),
                }
            }
            while let Some(status) = reader.try_recv_status() {
                match status {
                    DataReaderStatus::SubscriptionMatched { current, writer, .. }
                        if current.count_change() < 0 =>
                    {
                        self.last.remove(&writer);
                        all.push(Incoming::Gone { from: writer });
                    }
                    DataReaderStatus::RequestedIncompatibleQos { .. } => all.push(Incoming::Unfit { topic }),
                    _ => {}
                }
            }
        }
        // Sort across topics by time of arrival: a command sent before an `enable` must still be rejected.
        arrived.sort_by_key(|(when, _)| *when);
        let all: Vec<Incoming> = arrived.into_iter().map(|(_, message)| message).chain(all).collect();
        let messages =
            all.iter().filter(|came| matches!(came, Incoming::Message { .. } | Incoming::Broken { .. }));
        self.summary.received += messages.count() as u64;
        all
    }

    /// Counts a rejected message.
    pub(crate) fn refuse(&mut self) {
        self.summary.refused += 1;
    }

    pub(crate) fn close(self) -> Summary {
        self.summary
    }
}

pub(super) fn qos(kind: Qos, rate_hz: f64) -> QosPolicies {
    let (durability, depth, window) = match kind {
        Qos::State => (Durability::Volatile, 1, (STATE_WINDOW_S * rate_hz).clamp(64.0, 30_000.0) as i32),
        Qos::Latched => (Durability::TransientLocal, 1, 256),
        Qos::Lossless => (Durability::Volatile, CLOUD_WINDOW, CLOUD_WINDOW),
        Qos::Image => (Durability::Volatile, 1, IMAGE_WINDOW),
        Qos::Command => (Durability::Volatile, 8, 64),
    };
    QosPolicyBuilder::new()
        .durability(durability)
        // Publishing never blocks: a message for which there is no room is skipped.
        .reliability(Reliability::Reliable { max_blocking_time: Duration::from_millis(0) })
        .history(History::KeepLast { depth })
        .resource_limits(ResourceLimits {
            max_samples: window,
            max_instances: window,
            max_samples_per_instance: window,
        })
        .build()
}

/// The domain, and the bridge's participant in it.
pub(super) struct DdsDomain {
    domain: u16,
    pub(super) participant: DomainParticipant,
    publisher: Publisher,
    subscriber: Subscriber,
    reach: NetworkScope,
    /// `None` for other scopes, and where the operating system does not allow it.
    loopback: Option<Loopback>,
}

impl DdsDomain {
    pub(super) fn open(domain: u16, reach: NetworkScope) -> Result<DdsDomain, Ros2Error> {
        let mut builder = DomainParticipantBuilder::new(domain).same_host_loopback(true);
        let loopback = if reach == NetworkScope::Localhost { Loopback::prepare() } else { None };
        builder = match (reach, &loopback) {
            (NetworkScope::Subnet, _) => builder,
            (NetworkScope::Localhost, Some(loopback)) => builder.with_only_networks(loopback.addresses()),
            // Others can reach the sockets, so only loopback is announced.
            (NetworkScope::Localhost, None) => builder.with_only_networks([std::net::Ipv4Addr::LOCALHOST]),
        };
        let failed = |what: &str, cause: rustdds::dds::CreateError| Ros2Error::Dds {
            domain,
            what: what.to_owned(),
            cause: cause.to_string(),
        };
        let participant = builder.build().map_err(|cause| failed("participant", cause))?;
        // At once: the participant's sockets are open already.
        if let Some(loopback) = &loopback {
            let close = loopback.close_to_others();
            close.map_err(|cause| Ros2Error::Dds {
                domain,
                what: "filter".into(),
                cause: cause.to_string(),
            })?;
        }
        let none = QosPolicyBuilder::new().build();
        let publisher = participant.create_publisher(&none).map_err(|cause| failed("publisher", cause))?;
        let subscriber = participant.create_subscriber(&none).map_err(|cause| failed("subscriber", cause))?;
        Ok(DdsDomain { domain, participant, publisher, subscriber, reach, loopback })
    }

    /// Restricts sockets opened since. Returns whether the operating system keeps other machines out, if that
    /// was requested.
    fn close_again(&self) -> Option<bool> {
        let is_closed = || self.loopback.as_ref().is_some_and(|it| it.close_to_others().is_ok());
        (self.reach == NetworkScope::Localhost).then(is_closed)
    }

    fn topic(&self, name: &str, kind: &str, qos: &QosPolicies) -> Result<Topic, Ros2Error> {
        let made = self.participant.create_topic(name.into(), kind.into(), qos, TopicKind::NoKey);
        made.map_err(|cause| self.failed(name, &cause.to_string()))
    }

    fn failed(&self, what: &str, cause: &str) -> Ros2Error {
        Ros2Error::Dds { domain: self.domain, what: what.to_owned(), cause: cause.to_owned() }
    }

    fn writer(&self, name: &str, kind: &str, qos: &QosPolicies) -> Result<Writer, Ros2Error> {
        let topic = self.topic(name, kind, qos)?;
        let made =
            self.publisher.create_datawriter_no_key::<OutgoingCdr, CdrAdapter>(&topic, Some(qos.clone()));
        made.map_err(|cause| self.failed(name, &cause.to_string()))
    }

    pub(super) fn reader(
        &self,
        name: &str,
        kind: &str,
        qos: &QosPolicies,
    ) -> Result<SimpleDataReader<ReceivedCdr, CdrAdapter>, Ros2Error> {
        let topic = self.topic(name, kind, qos)?;
        let made = self
            .subscriber
            .create_simple_datareader_no_key::<ReceivedCdr, CdrAdapter>(&topic, Some(qos.clone()));
        made.map_err(|cause| self.failed(name, &cause.to_string()))
    }

    /// Announces which publishers and subscriptions make up the node, as ROS 2's middleware does
    /// (rmw_dds_common, since Iron).
    fn make_known(
        &self,
        writers: &BTreeMap<Output, Writer>,
        readers: &[(Input, SimpleDataReader<ReceivedCdr, CdrAdapter>)],
    ) -> Result<Writer, Ros2Error> {
        let kind = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
        let known = self.writer("ros_discovery_info", kind, &qos(Qos::Latched, 1.0))?;
        let gid = |guid: GUID| Gid { data: guid.to_bytes() };
        let node = NodeEntitiesInfo {
            node_namespace: "/".into(),
            node_name: NODE.into(),
            reader_gid_seq: readers.iter().map(|(_, reader)| gid(reader.guid())).collect(),
            writer_gid_seq: writers.values().map(|writer| gid(writer.guid())).collect(),
        };
        let info =
            ParticipantEntitiesInfo { gid: gid(self.participant.guid()), node_entities_info_seq: vec![node] };
        let failed = |cause: String| self.failed("ros_discovery_info", &cause);
        let bytes = cdr::encode(&info).map_err(|cause| failed(cause.to_string()))?;
        known
            .write(OutgoingCdr(bytes.into()), Some(Timestamp::now()))
            .map_err(|cause| failed(cause.to_string()))?;
        Ok(known)
    }
}
