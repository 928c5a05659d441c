//! One connection: either a file of the page, or a client of the Foxglove protocol.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use delivery::viewer::MAX_MESSAGES_PER_S;
use futures_util::{SinkExt, StreamExt};
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio::sync::{mpsc, oneshot};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::protocol::{CloseFrame, Role, WebSocketConfig};
use tokio_tungstenite::tungstenite::{Error, Message};

use super::http::{Head, Refusal, answer_head, websocket_answer};
use super::pending::PendingConnection;
use super::{MAX_CLIENTS, Shared};
use crate::assets::asset;
use crate::board::Client;
use crate::calls::Call;
use crate::protocol::{self, ClientText, Level};
use crate::services::{
    NO_TOKEN, Outcome, Request, SERVICES, SLICE, is_command, read_request, response, same,
};
use crate::slice::MOST_UNDER_WAY;

/// Maximum length of a client message, bytes.
pub const MAX_CLIENT_MESSAGE: usize = 64 << 10;
/// Write timeout: a client that reads nothing for this long is disconnected.
const WRITE_LIMIT: Duration = Duration::from_secs(10);
/// Bytes written to the socket before reading from the client again.
const BATCH_BYTES: usize = 512 << 10;
/// Timeout from a connection without the token to its first message: silent ones must not keep others out.
const SILENT_LIMIT: Duration = Duration::from_secs(5);
/// Timeout of a service call.
const CALL_LIMIT: Duration = Duration::from_secs(10);
const END_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Time between two batches for a client that wants only the newest messages of streams.
const NEWEST_PERIOD: Duration = Duration::from_millis(33);

type Socket = WebSocketStream<TcpStream>;

/// Answers a request, and serves the WebSocket if it opens one. A client with permission to watch is no
/// longer a pending connection.
pub(super) async fn answer(
    mut stream: TcpStream,
    head: Result<Option<Head>, Refusal>,
    shared: &Shared,
    pending_connection: PendingConnection,
) {
    let head = match head {
        Ok(Some(head)) => head,
        Ok(None) => return,
        Err(refusal) => return refuse(&mut stream, &refusal).await,
    };
    let checked = shared.origins.check(&head, shared.own, shared.reach);
    if let Err(refusal) = checked {
        return refuse(&mut stream, &refusal).await;
    }
    if head.path.split('?').next() != Some("/ws") {
        return send_file(&mut stream, &head, shared).await;
    }
    let text = match websocket_answer(&head) {
        Ok(text) => text,
        Err(refusal) => return refuse(&mut stream, &refusal).await,
    };
    let is_owner = head.query("token").is_some_and(|given| same(given, &shared.token));
    let may_watch = shared.watch_by_anyone || is_owner;
    let room = if is_owner { &shared.room } else { &shared.watchers_room };
    let _place = match may_watch.then(|| Arc::clone(room).try_acquire_owned()) {
        Some(Err(_)) => {
            let text = format!("too many clients: {MAX_CLIENTS} are connected, which is the limit");
            return refuse(&mut stream, &Refusal::new("503 Service Unavailable", text)).await;
        }
        Some(Ok(place)) => {
            drop(pending_connection);
            Some(place)
        }
        None => None,
    };
    if stream.write_all(text.as_bytes()).await.is_ok() {
        let config = WebSocketConfig::default()
            .max_message_size(Some(MAX_CLIENT_MESSAGE))
            .max_frame_size(Some(MAX_CLIENT_MESSAGE));
        let socket = WebSocketStream::from_partially_read(stream, head.rest, Role::Server, Some(config));
        serve(socket.await, shared, may_watch, is_owner).await;
    }
}

async fn refuse(stream: &mut TcpStream, refusal: &Refusal) {
    send(stream, refusal.status, "text/plain; charset=utf-8", refusal.text.as_bytes(), Body::Sent).await;
}

async fn send_file(stream: &mut TcpStream, head: &Head, shared: &Shared) {
    let content = matches!(head.method.as_str(), "GET" | "HEAD")
        .then(|| asset(&head.path, shared.page_folder.as_deref()))
        .flatten();
    match content {
        Some(file) => {
            let body = if head.method == "GET" { Body::Sent } else { Body::HeadOnly };
            send(stream, "200 OK", file.media_type, &file.bytes, body).await;
        }
        None => refuse(stream, &Refusal::new("404 Not Found", format!("not found: {}", head.path))).await,
    }
}

/// Whether a response carries its content; a response to a HEAD request does not.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Body {
    Sent,
    HeadOnly,
}

async fn send(stream: &mut TcpStream, status: &str, media_type: &str, bytes: &[u8], body: Body) {
    let head = answer_head(status, media_type, bytes.len());
    let write = async {
        stream.write_all(head.as_bytes()).await?;
        if body == Body::Sent {
            stream.write_all(bytes).await?;
        }
        stream.shutdown().await
    };
    // A client that does not read the response has disconnected.
    let _ = tokio::time::timeout(WRITE_LIMIT, write).await;
}

/// Why a connection ends.
enum End {
    /// The client has disconnected or does not read.
    Gone,
    /// The server closes it, with a reason.
    Close(CloseCode, String),
}

impl From<Error> for End {
    fn from(error: Error) -> End {
        match error {
            Error::Capacity(cause) => End::Close(CloseCode::Size, cause.to_string()),
            Error::Protocol(cause) => End::Close(CloseCode::Protocol, cause.to_string()),
            Error::Utf8(cause) => End::Close(CloseCode::Invalid, cause),
            _ => End::Gone,
        }
    }
}

/// Serves a client. One without permission to watch gets only the reason: a browser shows the page the reason
/// for a closed WebSocket, but not for one that was never opened.
async fn serve(mut socket: Socket, shared: &Shared, may_watch: bool, is_owner: bool) {
    let end = match may_watch {
        true => {
            let client = shared.board.join();
            let end = session(&mut socket, &client, shared, is_owner).await;
            shared.board.leave(&client);
            end
        }
        false => Err(End::Close(CloseCode::Policy, NO_TOKEN.to_owned())),
    };
    if let Err(End::Close(code, reason)) = end {
        // A close frame holds at most 123 bytes.
        let mut length = reason.len().min(120);
        while !reason.is_char_boundary(length) {
            length -= 1;
        }
        let frame = CloseFrame { code, reason: reason[..length].into() };
        let _ = tokio::time::timeout(Duration::from_secs(1), socket.close(Some(frame))).await;
    }
}

async fn session(
    socket: &mut Socket,
    client: &Arc<Client>,
    shared: &Shared,
    is_owner: bool,
) -> Result<(), End> {
    let (answers, mut answered) = mpsc::unbounded_channel();
    let mut session = ClientSession {
        client,
        shared,
        answers,
        slices: 0,
        is_owner,
        has_requested: false,
        wants_newest: false,
    };
    let joined = Instant::now();
    say(socket, Message::text(protocol::server_info("trabecula", &shared.name))).await?;
    say(socket, Message::text(protocol::advertise(&shared.board.channels().advertisements()))).await?;
    say(socket, Message::text(protocol::advertise_services(&SERVICES))).await?;
    loop {
        let more = session.send_waiting(socket).await?;
        // If there is more to send, only polls for client messages.
        let pause = match session.wants_newest {
            _ if more => Duration::ZERO,
            true => NEWEST_PERIOD,
            false => END_CHECK_PERIOD,
        };
        tokio::select! {
            biased;
            message = socket.next() => match message {
                Some(message) => session.handle(socket, message?).await?,
                None => return Err(End::Gone),
            },
            answer = answered.recv() => if let Some((service, answer)) = answer {
                say(socket, answer).await?;
                session.slices -= usize::from(service == SLICE);
            },
            () = client.bell.notified(), if !more && !session.wants_newest => {}
            () = tokio::time::sleep(pause) => {}
        }
        if !is_owner && !session.has_requested && joined.elapsed() > SILENT_LIMIT {
            let text = format!("nothing was requested within {} s", SILENT_LIMIT.as_secs());
            return Err(End::Close(CloseCode::Policy, text));
        }
        if shared.end.load(Ordering::Relaxed) {
            while session.send_waiting(socket).await? {}
            session.tell_dropped(socket, client.last_drops_to_tell()).await?;
            return Err(End::Close(CloseCode::Away, shared.board.farewell().to_owned()));
        }
    }
}

/// Sends with a timeout: a client that reads nothing counts as disconnected.
async fn say(socket: &mut Socket, message: Message) -> Result<(), End> {
    tokio::time::timeout(WRITE_LIMIT, socket.send(message)).await.map_err(|_| End::Gone)?.map_err(End::from)
}

struct ClientSession<'a> {
    client: &'a Arc<Client>,
    shared: &'a Shared,
    /// Channel for the replies to calls, with the service's number.
    answers: mpsc::UnboundedSender<(u32, Message)>,
    /// Slices requested and not yet sent. Limits what a client can hold up, because it must read them before
    /// it requests more.
    slices: usize,
    /// Whether the client has presented the token.
    is_owner: bool,
    has_requested: bool,
    /// Whether it wants only the newest messages of a stream.
    wants_newest: bool,
}

impl ClientSession<'_> {
    /// Sends one batch of queued messages; returns whether there may be more.
    async fn send_waiting(&mut self, socket: &mut Socket) -> Result<bool, End> {
        let messages = match self.wants_newest {
            true => self.client.take_all(BATCH_BYTES),
            false => self.client.take(BATCH_BYTES),
        };
        let has_messages = !messages.is_empty();
        if has_messages {
            say(socket, Message::binary(protocol::time(self.shared.board.time_ns()))).await?;
        }
        let feed = async {
            for message in messages {
                let bytes = protocol::message_data(message.subscription, message.time_ns, &message.payload);
                socket.feed(Message::binary(bytes)).await?;
            }
            socket.flush().await
        };
        tokio::time::timeout(WRITE_LIMIT, feed).await.map_err(|_| End::Gone)?.map_err(End::from)?;
        self.tell_dropped(socket, self.client.drops_to_tell()).await?;
        Ok(has_messages && !self.wants_newest)
    }

    async fn tell_dropped(&self, socket: &mut Socket, dropped: Option<u64>) -> Result<(), End> {
        let Some(dropped) = dropped else { return Ok(()) };
        warn(socket, &format!("{dropped} messages were dropped: this client reads too slowly")).await
    }

    async fn handle(&mut self, socket: &mut Socket, message: Message) -> Result<(), End> {
        if !self.client.may_send() {
            let text = format!("rate limit exceeded: {MAX_MESSAGES_PER_S} messages per second");
            return Err(End::Close(CloseCode::Policy, text));
        }
        self.has_requested |= message.is_text() || message.is_binary();
        match message {
            Message::Text(text) => match serde_json::from_str::<ClientText>(&text) {
                Ok(text) => self.handle_text(socket, text).await,
                Err(error) => warn(socket, &format!("malformed message: {error}")).await,
            },
            Message::Binary(bytes) => self.call(socket, &bytes).await,
            Message::Close(_) => Err(End::Gone),
            // The library answers pings itself.
            Message::Ping(_) | Message::Pong(_) | Message::Frame(_) => Ok(()),
        }
    }

    async fn handle_text(&mut self, socket: &mut Socket, text: ClientText) -> Result<(), End> {
        let board = &self.shared.board;
        let refused: Vec<String> = match text {
            ClientText::Subscribe { subscriptions } => {
                self.wants_newest |= subscriptions.iter().any(|wanted| wanted.newest);
                let subscribed = subscriptions.into_iter().map(|wanted| board.subscribe(self.client, wanted));
                subscribed.filter_map(Result::err).collect()
            }
            ClientText::Unsubscribe { subscription_ids } => subscription_ids
                .into_iter()
                .filter_map(|id| board.unsubscribe(self.client, id).err())
                .collect(),
            ClientText::Other => {
                vec!["unsupported operation: this server offers only subscriptions and services".to_owned()]
            }
        };
        match refused.split_first() {
            None => Ok(()),
            Some((first, [])) => warn(socket, first).await,
            Some((first, others)) => warn(socket, &format!("{first}; and {} more", others.len())).await,
        }
    }

    async fn call(&mut self, socket: &mut Socket, bytes: &[u8]) -> Result<(), End> {
        let Some(call) = protocol::service_call(bytes) else {
            return warn(socket, "unsupported binary message: not a service call").await;
        };
        if call.encoding != "json" {
            let text = format!("expected a JSON request, got `{}`", call.encoding);
            return say(socket, Message::text(protocol::service_failure(&call, &text))).await;
        }
        let (service, number) = (call.service, call.call);
        let answer = match read_request(service, call.payload, &self.shared.token) {
            Err(error) => Err(error),
            Ok(Request::Slice(_)) if self.slices >= MOST_UNDER_WAY => {
                Err(format!("{MOST_UNDER_WAY} slices are in progress, which is the limit: wait for one"))
            }
            Ok(request) => {
                let is_slice = matches!(request, Request::Slice(_));
                let (answer, answered) = oneshot::channel();
                // A command has been checked for the token.
                let is_owner = self.is_owner || is_command(service);
                match self.shared.calls.try_send(Call { request, answer, is_owner }) {
                    Ok(()) => {
                        self.slices += usize::from(is_slice);
                        self.answer_later(service, number, answered);
                        return Ok(());
                    }
                    Err(_) => Err("the viewer is busy with earlier requests or is shutting down".to_owned()),
                }
            }
        };
        say(socket, message(service, number, answer)).await
    }

    fn answer_later(&self, service: u32, call: u32, answered: oneshot::Receiver<Outcome>) {
        let answers = self.answers.clone();
        tokio::task::spawn_local(async move {
            let outcome = match tokio::time::timeout(CALL_LIMIT, answered).await {
                Ok(Ok(outcome)) => outcome,
                Ok(Err(_)) | Err(_) => Err("request timed out: the run may have ended".to_owned()),
            };
            // The client may have disconnected.
            let _ = answers.send((service, message(service, call, outcome)));
        });
    }
}

fn message(service: u32, call: u32, outcome: Outcome) -> Message {
    let (encoding, payload) = response(outcome);
    Message::binary(protocol::service_response(service, call, encoding, &payload))
}

async fn warn(socket: &mut Socket, text: &str) -> Result<(), End> {
    say(socket, Message::text(protocol::status(Level::Warning, text))).await
}
