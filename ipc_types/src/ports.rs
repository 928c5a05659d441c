//! Publishers and subscribers of messages: bytes in shared memory, checked against their layout at both ends.

use core::marker::PhantomData;
use core::mem::MaybeUninit;

use iceoryx2::port::publisher::Publisher as RawPublisher;
use iceoryx2::port::subscriber::Subscriber as RawSubscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::ipc;
use iceoryx2::sample::Sample;
use thiserror::Error;

use crate::identity::Guard;
use crate::layout::Message;
use crate::messages::Part;
use crate::own::Own;

/// Messages of a wrong length that one look takes off a queue: whoever floods with them holds nobody up.
const REFUSED_AT_ONCE: usize = 64;
/// The same for messages of strangers on a part's service: more than any queue holds, because what comes behind them must
/// not come late.
const STRANGERS_AT_ONCE: usize = 1 << 14;

/// Why a message could not be sent or taken.
#[derive(Debug, Error)]
pub enum PortError {
    /// The publisher could not get a free sample.
    #[error(
        "service `{service}`: no sample to write {bytes} bytes into ({cause}); a message may have at most {limit} bytes"
    )]
    Loan {
        /// Service name.
        service: String,
        /// Bytes asked for.
        bytes: usize,
        /// Most bytes of a message of this publisher.
        limit: usize,
        /// iceoryx2's reason.
        cause: String,
    },
    /// The sample could not be delivered.
    #[error("service `{service}`: sending failed ({cause})")]
    Send {
        /// Service name.
        service: String,
        /// iceoryx2's reason.
        cause: String,
    },
    /// A connection to a publisher could not be read.
    #[error("service `{service}`: receiving failed ({cause})")]
    Receive {
        /// Service name.
        service: String,
        /// iceoryx2's reason.
        cause: String,
    },
    /// A message has not the length that its type and its own count say.
    #[error("service `{service}`: a message of {bytes} bytes arrived, expected {expected}")]
    Length {
        /// Service name.
        service: String,
        /// Bytes that came.
        bytes: usize,
        /// What was expected.
        expected: String,
    },
}

/// Sends messages of one type.
#[derive(Debug)]
pub struct Publisher<M> {
    raw: Own<RawPublisher<ipc::Service, [u8], ()>>,
    name: String,
    message: PhantomData<M>,
}

impl<M: Message> Publisher<M> {
    pub(crate) fn new(raw: RawPublisher<ipc::Service, [u8], ()>, name: String) -> Self {
        Publisher { raw: Own::new(raw), name, message: PhantomData }
    }

    /// Sends a message of fixed length.
    pub fn send(&self, message: &M) -> Result<(), PortError> {
        self.send_parts(&[message.as_bytes()])
    }

    /// Sends a message and the elements behind it; the message's last field must be their count.
    pub fn send_with_tail(&self, message: &M, tail: &[u8]) -> Result<(), PortError> {
        self.send_parts(&[message.as_bytes(), tail])
    }

    /// Sends the concatenation of some byte strings as one message.
    pub fn send_parts(&self, parts: &[&[u8]]) -> Result<(), PortError> {
        let bytes = parts.iter().map(|part| part.len()).sum();
        let mut sample = self.raw.loan_slice_uninit(bytes).map_err(|cause| PortError::Loan {
            service: self.name.clone(),
            bytes,
            limit: self.raw.initial_max_slice_len(),
            cause: format!("{cause:?}"),
        })?;
        let mut rest: &mut [MaybeUninit<u8>] = sample.payload_mut();
        for part in parts {
            let (head, tail) = rest.split_at_mut(part.len());
            for (target, byte) in head.iter_mut().zip(*part) {
                target.write(*byte);
            }
            rest = tail;
        }
        // SAFETY: the sample has exactly as many bytes as the parts together, and the loop wrote each part.
        let sample = unsafe { sample.assume_init() };
        sample
            .send()
            .map_err(|cause| PortError::Send { service: self.name.clone(), cause: format!("{cause:?}") })?;
        Ok(())
    }

    /// Delivers the history to subscribers that joined since the last call or message.
    pub fn deliver_history(&self) -> Result<(), PortError> {
        self.raw
            .update_connections()
            .map_err(|cause| PortError::Send { service: self.name.clone(), cause: format!("{cause:?}") })
    }
}

/// Receives messages of one type.
#[derive(Debug)]
pub struct Subscriber<M> {
    raw: Own<RawSubscriber<ipc::Service, [u8], ()>>,
    name: String,
    /// Of a service that parts of the hub alone write.
    guard: Option<Guard>,
    message: PhantomData<M>,
}

impl<M: Message> Subscriber<M> {
    pub(crate) fn new(
        raw: RawSubscriber<ipc::Service, [u8], ()>,
        name: String,
        guard: Option<Guard>,
    ) -> Self {
        Subscriber { raw: Own::new(raw), name, guard, message: PhantomData }
    }

    /// The oldest message that waits, if any. Its bytes stay in shared memory until the return value is dropped.
    ///
    /// A message of a wrong length is taken off the queue and reported. What a program has sent that is not the part whose
    /// service this is, is passed over and counted ([`Subscriber::strangers`]).
    pub fn receive(&self) -> Result<Option<Received<M>>, PortError> {
        for _ in 0..STRANGERS_AT_ONCE {
            let sample = self.raw.receive().map_err(|cause| PortError::Receive {
                service: self.name.clone(),
                cause: format!("{cause:?}"),
            })?;
            let Some(sample) = sample else { return Ok(None) };
            let part = match &self.guard {
                None => None,
                Some(guard) => match guard.part_of(sample.header().publisher_id()) {
                    None => continue,
                    known => known,
                },
            };
            return Received::new(sample, part, &self.name).map(Some);
        }
        Ok(None)
    }

    /// Messages so far of programs that are not the part whose service this is.
    pub fn strangers(&self) -> u64 {
        self.guard.as_ref().map_or(0, Guard::strangers)
    }

    /// The oldest message of a right length that waits, if any, for services that every client may write: others are
    /// taken off the queue and handed to `refused`, so many at a time that the caller goes on.
    ///
    /// # Errors
    /// [`PortError::Receive`].
    pub fn receive_valid(
        &self,
        mut refused: impl FnMut(&PortError),
    ) -> Result<Option<Received<M>>, PortError> {
        for _ in 0..REFUSED_AT_ONCE {
            match self.receive() {
                Err(error @ PortError::Length { .. }) => refused(&error),
                other => return other,
            }
        }
        Ok(None)
    }

    /// The newest message that waits, if any; older ones are dropped.
    pub fn receive_newest(&self) -> Result<Option<Received<M>>, PortError> {
        let mut newest = None;
        while let Some(received) = self.receive()? {
            newest = Some(received);
        }
        Ok(newest)
    }

    /// Whether a message waits.
    pub fn has_message(&self) -> bool {
        self.raw.has_samples().unwrap_or(true)
    }
}

/// A message in shared memory. Whoever decides on its content first copies it: its writer is another process.
#[derive(Debug)]
pub struct Received<M> {
    pub(crate) sample: Own<Sample<ipc::Service, [u8], ()>>,
    part: Option<Part>,
    /// The message, if it does not lie aligned in shared memory.
    copy: Option<Box<M>>,
}

impl<M: Message> Received<M> {
    fn new(
        sample: Sample<ipc::Service, [u8], ()>,
        part: Option<Part>,
        service: &str,
    ) -> Result<Self, PortError> {
        let bytes = sample.payload();
        M::DESCRIPTION.check_length(bytes).map_err(|expected| PortError::Length {
            service: service.to_owned(),
            bytes: bytes.len(),
            expected,
        })?;
        let copy = match M::ref_from_prefix(bytes) {
            Ok(_) => None,
            Err(_) => M::read_from_prefix(bytes).ok().map(|(message, _)| Box::new(message)),
        };
        Ok(Received { sample: Own::new(sample), part, copy })
    }

    /// The part that has sent it; none on services that every client may write.
    pub fn part(&self) -> Option<Part> {
        self.part
    }

    /// The message without what follows it. Not a copy.
    pub fn message(&self) -> &M {
        match &self.copy {
            Some(copy) => copy,
            // SAFETY: `new` has found at least a message's bytes and, as there is no copy, has proved with
            // `ref_from_prefix` that a reference to an `M` may point at them; the sample keeps them where they are
            // for as long as `self` lives, and no writer is given them before it is dropped.
            None => unsafe { &*self.sample.payload().as_ptr().cast::<M>() },
        }
    }

    /// What follows the message: its tail, or a frame's image. Not a copy.
    pub fn tail(&self) -> &[u8] {
        &self.sample.payload()[M::DESCRIPTION.size..]
    }

    /// All bytes, as they lie in shared memory.
    pub fn bytes(&self) -> &[u8] {
        self.sample.payload()
    }
}
