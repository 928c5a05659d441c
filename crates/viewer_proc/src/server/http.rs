//! The part of HTTP needed to serve a page and open a WebSocket.

use std::net::SocketAddr;

use tokio::io::{AsyncRead, AsyncReadExt};
use tokio_tungstenite::tungstenite::handshake::derive_accept_key;

use crate::protocol::SUBPROTOCOLS;

/// Maximum length of a request head, bytes.
const MAX_HEAD: usize = 8 << 10;
const MAX_HEADERS: usize = 64;
/// The page may load nothing from elsewhere. `blob:` is for images that it creates itself.
const CONTENT_SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' blob: data:; \
    style-src 'self' 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; \
    object-src 'none'";

/// The head of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Head {
    /// Method.
    pub method: String,
    /// Path with query.
    pub path: String,
    headers: Vec<(String, String)>,
    /// Bytes already read after the head.
    pub rest: Vec<u8>,
}

/// Why a request is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Refusal {
    /// HTTP status.
    pub status: &'static str,
    /// Text for the user.
    pub text: String,
}

impl Refusal {
    /// Creates a refusal with this status and text.
    pub fn new(status: &'static str, text: impl Into<String>) -> Refusal {
        Refusal { status, text: text.into() }
    }
}

impl Head {
    /// Returns a header's value; `name` in lower case.
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(known, _)| known == name).map(|(_, value)| value.as_str())
    }

    /// Returns the value of a header that must be unique because it decides access, or `None` if absent.
    ///
    /// # Errors
    /// Duplicate header: another reader, such as a proxy, may use the other value.
    fn only(&self, name: &str) -> Result<Option<&str>, Refusal> {
        let mut all = self.headers.iter().filter(|(known, _)| known == name);
        match (all.next(), all.next()) {
            (first, None) => Ok(first.map(|(_, value)| value.as_str())),
            (_, Some(_)) => Err(Refusal::new("400 Bad Request", format!("duplicate `{name}` header"))),
        }
    }

    /// Returns a raw value from the path's query. Not percent-decoded: a token needs no escapes.
    pub fn query(&self, name: &str) -> Option<&str> {
        let (_, query) = self.path.split_once('?')?;
        let mut pairs = query.split('&').filter_map(|pair| pair.split_once('='));
        pairs.find(|(known, _)| *known == name).map(|(_, value)| value)
    }

    fn has_token(&self, name: &str, token: &str) -> bool {
        self.header(name)
            .is_some_and(|value| value.split(',').any(|part| part.trim().eq_ignore_ascii_case(token)))
    }
}

/// Reads a request's head; `None` if the client disconnected.
///
/// # Errors
/// Too long, or not HTTP.
pub async fn read_head(stream: &mut (impl AsyncRead + Unpin)) -> Result<Option<Head>, Refusal> {
    let mut bytes = Vec::new();
    loop {
        let mut part = [0; 1024];
        match stream.read(&mut part).await {
            Ok(count) if count > 0 => bytes.extend_from_slice(&part[..count]),
            _ => return Ok(None),
        }
        if let Some(head) = parse(&bytes)? {
            return Ok(Some(head));
        }
        if bytes.len() > MAX_HEAD {
            let text = format!("the request head is longer than {MAX_HEAD} bytes");
            return Err(Refusal::new("431 Request Header Fields Too Large", text));
        }
    }
}

/// Parses the head of a request; `None` if it is incomplete.
///
/// # Errors
/// Not HTTP.
pub fn parse(bytes: &[u8]) -> Result<Option<Head>, Refusal> {
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut request = httparse::Request::new(&mut headers);
    let bad =
        |error: httparse::Error| Refusal::new("400 Bad Request", format!("not an HTTP request: {error}"));
    let httparse::Status::Complete(length) = request.parse(bytes).map_err(bad)? else { return Ok(None) };
    let text = |header: &httparse::Header<'_>| {
        (header.name.to_ascii_lowercase(), String::from_utf8_lossy(header.value).trim().to_owned())
    };
    Ok(Some(Head {
        method: request.method.unwrap_or("").to_owned(),
        path: request.path.unwrap_or("").to_owned(),
        headers: request.headers.iter().map(text).collect(),
        rest: bytes[length..].to_vec(),
    }))
}

/// Who can reach the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reach {
    /// Programs on this machine: only its own address and loopback are valid hosts.
    Loopback,
    /// Other machines too: any address of this machine is a valid host.
    Network,
}

/// A host that requests may name although it is not the server's address: the near end of a tunnel, a name
/// of this machine, a published port of a container.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AllowedHost {
    /// Lower case, or an IPv6 address in brackets.
    name: String,
    port: u16,
}

impl AllowedHost {
    /// Returns whether a `host` header names it. Browsers omit port 80 and, behind a proxy with TLS, port
    /// 443.
    fn is(&self, host: &str) -> bool {
        host.eq_ignore_ascii_case(&self.to_string())
            || (matches!(self.port, 80 | 443) && host.eq_ignore_ascii_case(&self.name))
    }
}

impl core::fmt::Display for AllowedHost {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}:{}", self.name, self.port)
    }
}

impl core::str::FromStr for AllowedHost {
    type Err = &'static str;

    /// Reads `NAME:PORT`. One exact host: neither patterns nor a missing port, which would allow more hosts
    /// than the user means.
    fn from_str(text: &str) -> Result<AllowedHost, &'static str> {
        const EXPECTED: &str = "expected NAME:PORT, such as localhost:9000 or lab-pc.example:8765";
        let (name, port) = text.rsplit_once(':').ok_or(EXPECTED)?;
        let bracketed = name.strip_prefix('[').and_then(|inner| inner.strip_suffix(']'));
        let is_name = match bracketed {
            Some(inner) => inner.parse::<std::net::Ipv6Addr>().is_ok(),
            None => {
                let allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"-._".contains(&byte);
                (1..=253).contains(&name.len()) && name.bytes().all(allowed)
            }
        };
        let number = port.parse::<u16>().ok().filter(|number| *number > 0 && number.to_string() == port);
        match number {
            Some(port) if is_name => Ok(AllowedHost { name: name.to_ascii_lowercase(), port }),
            _ => Err(EXPECTED),
        }
    }
}

/// Which pages may open a WebSocket.
#[derive(Debug, Clone, Default)]
pub struct Origins {
    /// Origins in addition to the page's own, such as `http://localhost:8080`.
    pub allowed: Vec<String>,
    /// Hosts in addition to the server's own address.
    pub hosts: Vec<AllowedHost>,
}

impl Origins {
    /// Refuses requests from other pages by the origin that browsers always send. Also compares the host
    /// exactly, so that a foreign name that resolves to this machine (DNS rebinding) is not accepted.
    ///
    /// # Errors
    /// Another host or origin; a missing or duplicate header.
    pub fn check(&self, head: &Head, own: SocketAddr, reach: Reach) -> Result<(), Refusal> {
        let Some(host) = head.only("host")? else {
            return Err(Refusal::new("400 Bad Request", "missing `host` header"));
        };
        if !is_ours(host, own, reach) && !self.hosts.iter().any(|allowed| allowed.is(host)) {
            let mut text = format!("unexpected host `{host}`; expected {own}");
            if let Ok(host) = host.parse::<AllowedHost>() {
                text += &format!("; if it is a tunnel to this viewer, allow it with --allow-host {host}");
            }
            return Err(Refusal::new("403 Forbidden", text));
        }
        let Some(origin) = head.only("origin")? else { return Ok(()) };
        if origin == format!("http://{host}") || self.allowed.iter().any(|allowed| allowed == origin) {
            return Ok(());
        }
        let text = format!("pages of {origin} may not connect; allow it with --allow-origin {origin}");
        Err(Refusal::new("403 Forbidden", text))
    }
}

/// Returns whether a request's host is this server: an address or the name of loopback, with its port.
/// Browsers omit port 80.
fn is_ours(host: &str, own: SocketAddr, reach: Reach) -> bool {
    let name = match host.strip_suffix(&format!(":{}", own.port())) {
        Some(name) => name,
        None if own.port() == 80 => host,
        None => return false,
    };
    let whole = format!("{name}:{}", own.port());
    let is_address = |it: SocketAddr| {
        // Only the canonical spelling: no zone, no other number format.
        it.to_string() == whole && (it == own || reach == Reach::Network || it.ip().is_loopback())
    };
    name == "localhost" || whole.parse().is_ok_and(is_address)
}

/// Answers a WebSocket handshake.
///
/// # Errors
/// Not a handshake, or no supported subprotocol.
pub fn websocket_answer(head: &Head) -> Result<String, Refusal> {
    let key = head.only("sec-websocket-key")?.filter(|key| key.len() == 24);
    let opens = head.has_token("connection", "upgrade")
        && head.has_token("upgrade", "websocket")
        && head.only("sec-websocket-version")? == Some("13");
    let Some(key) = key.filter(|_| opens) else {
        let text = "this address expects a WebSocket handshake (version 13)";
        return Err(Refusal::new("426 Upgrade Required", text));
    };
    let spoken = SUBPROTOCOLS.iter().find(|name| head.has_token("sec-websocket-protocol", name));
    let Some(spoken) = spoken else {
        let text = format!("unsupported subprotocol; expected one of {}", SUBPROTOCOLS.join(", "));
        return Err(Refusal::new("400 Bad Request", text));
    };
    Ok(format!(
        "HTTP/1.1 101 Switching Protocols\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
         Sec-WebSocket-Accept: {}\r\nSec-WebSocket-Protocol: {spoken}\r\n\r\n",
        derive_accept_key(key.as_bytes())
    ))
}

/// Returns the head of a response, without its content.
pub fn answer_head(status: &str, media_type: &str, length: usize) -> String {
    format!(
        "HTTP/1.1 {status}\r\nContent-Type: {media_type}\r\nContent-Length: {length}\r\nConnection: close\r\n\
         Cache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
         Cross-Origin-Opener-Policy: same-origin\r\n\
         Content-Security-Policy: {CONTENT_SECURITY_POLICY}\r\n\r\n"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn head(host: &str, origin: Option<&str>) -> Head {
        let origin = origin.map_or(String::new(), |origin| format!("Origin: {origin}\r\n"));
        parse(format!("GET /ws HTTP/1.1\r\nHost: {host}\r\n{origin}\r\n").as_bytes()).unwrap().unwrap()
    }

    const OWN: &str = "127.0.0.1:8765";

    fn check(head: &Head, reach: Reach) -> Result<(), Refusal> {
        let origins = Origins { allowed: vec!["http://studio.example".to_owned()], hosts: Vec::new() };
        origins.check(head, OWN.parse().unwrap(), reach)
    }

    #[test]
    fn other_origins_and_other_names_are_refused() {
        let check = |host, origin| check(&head(host, origin), Reach::Loopback).is_ok();
        assert!(check(OWN, None) && check("localhost:8765", None));
        assert!(check(OWN, Some("http://127.0.0.1:8765")) && check(OWN, Some("http://studio.example")));
        for origin in ["http://evil.example", "null", "https://127.0.0.1:8765", "http://127.0.0.1:80", ""] {
            assert!(!check(OWN, Some(origin)), "{origin}");
        }
        assert!(
            !check("evil.example:8765", Some("http://evil.example:8765")),
            "a name bound to this machine"
        );
    }

    /// The whole host must match, not only the part before the last colon.
    #[test]
    fn a_host_that_only_begins_like_ours_is_refused() {
        for host in [
            "127.0.0.1:8765.evil.example",
            "127.0.0.1:evil.example",
            "localhost:8765.evil.example",
            "localhost:evil.example:8765",
            "evil.example@127.0.0.1:8765",
            "127.0.0.1:8765@evil.example",
            "127.0.0.1:8765:8765",
            "[::1]evil.example:8765",
            "127.0.0.1:08765",
            "127.0.0.01:8765",
            "127.0.0.1:",
            "127.0.0.1",
            "127.0.0.1:8766",
            "localhost.:8765",
            "localhost.evil.example:8765",
            "127.0.0.1:8765, evil.example",
            "",
        ] {
            let origin = format!("http://{host}");
            for reach in [Reach::Loopback, Reach::Network] {
                assert!(check(&head(host, None), reach).is_err(), "{host}");
                assert!(check(&head(host, Some(&origin)), reach).is_err(), "{host}");
            }
        }
        assert!(check(&head("10.0.0.7:8765", None), Reach::Loopback).is_err());
        assert!(check(&head("10.0.0.7:8765", None), Reach::Network).is_ok());
        assert!(check(&head("[::1]:8765", None), Reach::Loopback).is_ok());
        // Browsers omit port 80.
        let origins = Origins::default();
        for (host, ours) in [("127.0.0.1", true), ("127.0.0.1:80", true), ("evil.example", false)] {
            let at_80 = origins.check(&head(host, None), "127.0.0.1:80".parse().unwrap(), Reach::Loopback);
            assert_eq!(at_80.is_ok(), ours, "{host}");
        }
    }

    /// Regression: behind `ssh -L 9000:localhost:8765`, a host name or a container's published port every
    /// request was refused, and no option helped.
    #[test]
    fn allowed_hosts_are_accepted_exactly_and_their_pages_connect() {
        let hosts = ["localhost:9000", "Lab-PC.example:8765", "[::1]:9000", "plain.example:80"];
        let hosts = hosts.map(|host| host.parse().unwrap()).to_vec();
        let origins = Origins { allowed: Vec::new(), hosts };
        let check = |host: &str, origin: Option<&str>| {
            origins.check(&head(host, origin), OWN.parse().unwrap(), Reach::Loopback)
        };
        for host in ["localhost:9000", "lab-pc.example:8765", "LAB-PC.EXAMPLE:8765", "[::1]:9000", OWN] {
            check(host, None).unwrap();
            check(host, Some(&format!("http://{host}"))).unwrap();
            assert!(check(host, Some("http://evil.example")).is_err(), "{host}");
        }
        check("plain.example", Some("http://plain.example")).unwrap();
        for host in [
            "evil.example:9000",
            "localhost:9001",
            "localhost:9000.evil.example",
            "localhost.evil.example:9000",
            "localhost:9000:9000",
            "lab-pc.example",
            "lab-pc.example:80",
            "sub.lab-pc.example:8765",
            "plain.example:443",
            "x@localhost:9000",
        ] {
            let refused = check(host, Some(&format!("http://{host}"))).unwrap_err();
            assert_eq!(refused.status, "403 Forbidden", "{host}");
        }
        let refused = check("localhost:9001", None).unwrap_err();
        assert!(refused.text.ends_with("--allow-host localhost:9001"), "{}", refused.text);
    }

    #[test]
    fn an_allowed_host_is_one_name_and_one_port() {
        for wrong in [
            "",
            "localhost",
            ":9000",
            "localhost:",
            "localhost:0",
            "localhost:09000",
            "localhost:65536",
            "*:9000",
            "*.example:80",
            "http://localhost:9000",
            "a b:1",
            "[::1:9000",
            "[evil]:9000",
            "::1:9000",
            "a@b:1",
        ] {
            assert!(wrong.parse::<AllowedHost>().is_err(), "{wrong}");
        }
    }

    /// Two host headers must be refused: a proxy may use the other one.
    #[test]
    fn headers_that_decide_access_must_be_unique() {
        let head =
            |lines: &str| parse(format!("GET /ws HTTP/1.1\r\n{lines}\r\n").as_bytes()).unwrap().unwrap();
        let own = format!("Host: {OWN}\r\n");
        let origin = format!("Origin: http://{OWN}\r\n");
        assert!(check(&head(&format!("{own}{origin}")), Reach::Loopback).is_ok());
        for lines in [
            String::new(),
            format!("{own}Host: evil.example\r\n"),
            format!("Host: evil.example\r\n{own}"),
            format!("{own}{own}"),
            format!("{own}{origin}Origin: http://evil.example\r\n"),
        ] {
            let refused = check(&head(&lines), Reach::Loopback).unwrap_err();
            assert_eq!(refused.status, "400 Bad Request", "{lines}");
        }
        let key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";
        assert!(websocket_answer(&head(&format!("{own}{key}{key}"))).is_err());
    }

    #[test]
    fn the_token_is_read_from_the_query() {
        let head = |path: &str| parse(format!("GET {path} HTTP/1.1\r\n\r\n").as_bytes()).unwrap().unwrap();
        assert_eq!(head("/ws?token=c0ffee").query("token"), Some("c0ffee"));
        assert_eq!(head("/ws?a=1&token=c0ffee&b").query("token"), Some("c0ffee"));
        for path in ["/ws", "/ws?", "/ws?token", "/ws?tokens=1", "/token=1"] {
            assert_eq!(head(path).query("token"), None, "{path}");
        }
    }

    #[test]
    fn the_accept_key_is_that_of_the_rfc() {
        let text = "GET /ws HTTP/1.1\r\nHost: x\r\nConnection: keep-alive, Upgrade\r\nUpgrade: WebSocket\r\n\
            Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
            Sec-WebSocket-Protocol: a, foxglove.websocket.v1\r\n\r\n";
        let answer = websocket_answer(&parse(text.as_bytes()).unwrap().unwrap()).unwrap();
        // RFC 6455, section 1.3.
        assert!(answer.contains("Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n"), "{answer}");
        assert!(answer.contains("Sec-WebSocket-Protocol: foxglove.websocket.v1\r\n"));
        assert!(websocket_answer(&head("x", None)).is_err());
    }
}
