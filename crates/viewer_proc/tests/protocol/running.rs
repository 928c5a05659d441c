//! A running server, and the client side of the protocol.

use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use futures_util::{SinkExt, StreamExt};
use run_log::Topic;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Error, Message};
use tokio_tungstenite::{WebSocketStream, client_async};
use viewer_proc::ServerOptions;
use viewer_proc::board::Board;
use viewer_proc::calls::{Call, Calls, call_queue};
use viewer_proc::channels::Channels;
use viewer_proc::server::{ListeningPort, Server};

const LIMIT: Duration = Duration::from_secs(20);

pub fn options(watch_by_anyone: bool) -> ServerOptions {
    ServerOptions {
        bind: "127.0.0.1".parse().unwrap(),
        port: 0,
        allow_origin: vec!["http://studio.example".to_owned()],
        allow_host: vec!["tunnel.example:9000".parse().unwrap()],
        watch_by_anyone,
        page_folder: None,
    }
}

pub struct Running {
    pub address: std::net::SocketAddr,
    pub token: String,
    pub board: Arc<Board>,
    pub over: Arc<AtomicBool>,
    pub called: Calls,
    serving: Option<JoinHandle<()>>,
}

impl Running {
    pub fn start(watch_by_anyone: bool) -> Running {
        let board = Arc::new(Board::new(Channels::new(&["viewer".to_owned()], false)));
        let (calls, called) = call_queue(8);
        let over = Arc::new(AtomicBool::new(false));
        let door = ListeningPort::open(&options(watch_by_anyone)).unwrap();
        let server = Server::behind(&door, "test", Arc::clone(&board), calls, Arc::clone(&over)).unwrap();
        let (address, token) = (door.address(), door.token().to_owned());
        assert_eq!(door.url(), format!("http://{address}/#token={token}"));
        let serving = Some(std::thread::spawn(move || server.serve().unwrap()));
        Running { address, token, board, over, called, serving }
    }

    /// Returns the next call that has arrived.
    pub async fn next_call(&self) -> Call {
        loop {
            match self.called.try_recv() {
                Ok(call) => return call,
                Err(_) => tokio::time::sleep(Duration::from_millis(1)).await,
            }
        }
    }

    /// Waits until somebody has subscribed to the states, or nobody.
    pub async fn states_are_wanted(&self, wanted: bool) {
        while self.board.wants(Topic::State.name()) != wanted {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }

    pub async fn tcp(&self) -> TcpStream {
        TcpStream::connect(self.address).await.unwrap()
    }

    pub async fn open(&self, protocol: &str, origin: Option<&str>) -> Result<Socket, Error> {
        self.open_with(&format!("?token={}", self.token), protocol, origin).await
    }

    pub async fn open_with(
        &self,
        query: &str,
        protocol: &str,
        origin: Option<&str>,
    ) -> Result<Socket, Error> {
        let mut request = format!("ws://{}/ws{query}", self.address).into_client_request().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", protocol.parse().unwrap());
        if let Some(origin) = origin {
            request.headers_mut().insert("Origin", origin.parse().unwrap());
        }
        let (socket, response) = client_async(request, self.tcp().await).await?;
        assert_eq!(response.headers()["Sec-WebSocket-Protocol"], protocol);
        Ok(socket)
    }

    /// Connects a client and reads the server info and the channels by topic.
    pub async fn client(&self) -> (Socket, Vec<Value>) {
        let mut socket = self.open("foxglove.sdk.v1", None).await.unwrap();
        assert_eq!(next_text(&mut socket).await["op"], "serverInfo");
        let advertised = next_text(&mut socket).await;
        assert_eq!(advertised["op"], "advertise");
        assert_eq!(next_text(&mut socket).await["op"], "advertiseServices");
        (socket, advertised["channels"].as_array().unwrap().clone())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        let (serving, begin) = (self.serving.take().unwrap(), Instant::now());
        while !serving.is_finished() {
            assert!(begin.elapsed() < LIMIT, "the server's end: not within {LIMIT:?}");
            std::thread::sleep(Duration::from_millis(1));
        }
        serving.join().unwrap();
    }
}

pub type Socket = WebSocketStream<TcpStream>;

pub fn with_server<F: Future<Output = ()>>(body: impl FnOnce(Rc<Running>) -> F) {
    with(Running::start(false), body);
}

pub fn with<F: Future<Output = ()>>(running: Running, body: impl FnOnce(Rc<Running>) -> F) {
    let running = Rc::new(running);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    runtime.block_on(async { tokio::time::timeout(LIMIT, body(running)).await.unwrap() });
}

pub async fn next_text(socket: &mut Socket) -> Value {
    loop {
        match socket.next().await.unwrap().unwrap() {
            Message::Text(text) => return serde_json::from_str(&text).unwrap(),
            Message::Binary(_) => {}
            other => panic!("{other:?}"),
        }
    }
}

/// Returns subscription, log time and payload of the next channel message.
pub async fn next_data(socket: &mut Socket) -> (u32, u64, Vec<u8>) {
    loop {
        match socket.next().await.unwrap().unwrap() {
            Message::Binary(bytes) if bytes[0] == 1 => {
                let subscription = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                return (
                    subscription,
                    u64::from_le_bytes(bytes[5..13].try_into().unwrap()),
                    bytes[13..].to_vec(),
                );
            }
            Message::Close(frame) => panic!("{frame:?}"),
            _ => {}
        }
    }
}

pub async fn say(socket: &mut Socket, value: Value) {
    socket.send(Message::text(value.to_string())).await.unwrap();
}

pub async fn subscribe(socket: &mut Socket, id: u32, channel: &Value) {
    say(socket, json!({"op": "subscribe", "subscriptions": [{"id": id, "channelId": channel["id"]}]})).await;
}

pub fn channel<'a>(channels: &'a [Value], topic: &str) -> &'a Value {
    channels.iter().find(|channel| channel["topic"] == topic).unwrap()
}

pub async fn close_code(socket: &mut Socket) -> CloseCode {
    loop {
        match socket.next().await {
            Some(Ok(Message::Close(Some(frame)))) => return frame.code,
            Some(Ok(_)) => {}
            other => panic!("closed without a reason: {other:?}"),
        }
    }
}

pub fn call_bytes(service: u32, call: u32, body: &Value) -> Message {
    let mut bytes = vec![2];
    for word in [service, call, 4] {
        bytes.extend_from_slice(&word.to_le_bytes());
    }
    bytes.extend_from_slice(b"json");
    bytes.extend_from_slice(body.to_string().as_bytes());
    Message::binary(bytes)
}

/// Returns the call's number and the response.
pub async fn next_response(socket: &mut Socket) -> (u32, Value) {
    loop {
        if let Message::Binary(bytes) = socket.next().await.unwrap().unwrap()
            && bytes[0] == 3
        {
            assert_eq!(&bytes[9..17], b"\x04\0\0\0json");
            return (
                u32::from_le_bytes(bytes[5..9].try_into().unwrap()),
                serde_json::from_slice(&bytes[17..]).unwrap(),
            );
        }
    }
}

pub async fn http(running: &Running, request: &str) -> String {
    let mut stream = running.tcp().await;
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    // The server may close before it has read everything.
    let _ = stream.read_to_end(&mut answer).await;
    String::from_utf8_lossy(&answer).into_owned()
}
