//! TLS and mutual TLS.

use std::{sync::Arc, time::Duration};

use rustls::{ClientConfig, RootCertStore, crypto::ring};
use rustls_pki_types::{CertificateDer, ServerName, pem::PemObject as _};
use tokio::{
    io::{AsyncReadExt as _, AsyncWriteExt as _},
    net::TcpStream,
    time::timeout,
};
use tokio_rustls::{TlsConnector, client::TlsStream};
use vbar_client::{Code, Credentials};
use vbar_server::{AccessOptions, Config, Node, StartError};

use super::{
    authority::{Authority, Certificate, Files, credentials, entry, token_entry},
    callers::{Server, exchange, until},
};

const SOON: Duration = Duration::from_millis(20);

/// A connection that agreed on `protocol`.
async fn encrypted(
    server: &Server,
    authority: &Authority,
    protocol: &[u8],
) -> TlsStream<TcpStream> {
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_slice(&authority.pem()).unwrap()).unwrap();
    let mut config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_root_certificates(roots)
        .with_no_client_auth();
    config.alpn_protocols = vec![protocol.to_vec()];
    let stream = TcpStream::connect(server.address).await.unwrap();
    let name = ServerName::try_from("localhost").unwrap();
    TlsConnector::from(Arc::new(config)).connect(name, stream).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn tls_port_speaks_grpc_and_http_to_whom_it_can_prove_itself_and_nothing_in_clear() {
    let (authority, files) = (Authority::new(), Files::new());
    let server = Server::start(files.tls(&authority.node(), None)).await;
    let client = server.client(credentials(&authority, None)).await.unwrap();
    assert!(client.is_serving().await.unwrap());
    assert!(client.server_info().await.is_ok());

    let stream = encrypted(&server, &authority, b"http/1.1").await;
    let request = b"GET /healthz HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n";
    assert_eq!(exchange(stream, request).await.status, 200);

    // The caller does not believe a node that another authority vouches for.
    let stranger = server.client(credentials(&Authority::new(), None)).await.unwrap_err();
    assert!(stranger.message.contains("certificate"), "{stranger}");

    // Plain text, of HTTP/1.1, of HTTP/2 and of nothing known, gets no answer in its own words.
    for plain in ["GET /healthz HTTP/1.1\r\n\r\n", "PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", "\0\0\0"] {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all(plain.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        let read = stream.read_to_end(&mut answer);
        let _ = timeout(Duration::from_secs(30), read).await.expect("the connection ends");
        assert!(!answer.starts_with(b"HTTP"), "{answer:?}");
        assert!(!answer.windows(5).any(|part| part == b"alive"), "{answer:?}");
    }
    assert!(client.is_serving().await.unwrap(), "the node goes on");
}

#[tokio::test(flavor = "multi_thread")]
async fn mutual_tls_takes_certificates_of_its_authority_only_while_they_are_valid() {
    let (authority, callers, files) = (Authority::new(), Authority::new(), Files::new());
    let server = Server::start(files.tls(&authority.node(), Some(&callers))).await;
    let asks = async |own: Option<&Certificate>| {
        let client = server.client(credentials(&authority, own)).await?;
        client.server_info().await.map(|_| ())
    };
    let good = callers.caller("loop-1", 2100);
    asks(Some(&good)).await.unwrap();
    for (what, own) in [
        ("no certificate", None),
        ("of another authority", Some(Authority::new().caller("loop-1", 2100))),
        ("expired", Some(callers.caller("loop-1", 2020))),
        ("for nodes, not callers", Some(callers.node())),
    ] {
        // What the caller is told of it is a matter of timing: its first words may meet a
        // connection that is closed already.
        let error = asks(own.as_ref()).await.unwrap_err();
        assert_eq!(error.code, Code::Unavailable, "{what}: {error}");
    }
    asks(Some(&good)).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn mutual_tls_with_a_file_of_names_gives_each_certificate_its_roles() {
    let (authority, files) = (Authority::new(), Files::new());
    let (known, stranger) = (authority.caller("a", 2100), authority.caller("b", 2100));
    let names = entry("certificate", "loop-1", &known.sha256, &["step"], "")
        + &token_entry("planner", "vbar_planner", &["plan"], "");
    let tokens_file = Some(files.write("tokens.toml", names));
    let access = AccessOptions { tokens_file, ..files.tls(&authority.node(), Some(&authority)) };
    let server = Server::start(access).await;

    let client = server.client(credentials(&authority, Some(&known))).await.unwrap();
    assert!(client.server_info().await.is_ok());
    let denied = client.list_plans(Default::default()).await.unwrap_err();
    assert_eq!(denied.code, Code::PermissionDenied);
    assert!(denied.message.contains("plan") && denied.message.contains("loop-1"), "{denied}");

    let client = server.client(credentials(&authority, Some(&stranger))).await.unwrap();
    assert_eq!(client.server_info().await.unwrap_err().code, Code::Unauthenticated);
    assert!(client.is_serving().await.unwrap());

    // A token on top asks in the token's name, and a wrong one is not made up for.
    for (token, code) in [("vbar_planner", Code::Ok), ("vbar_other", Code::Unauthenticated)] {
        let token = Some(token.to_owned());
        let credentials = Credentials { token, ..credentials(&authority, Some(&known)) };
        let client = server.client(credentials).await.unwrap();
        let listed = client.list_plans(Default::default()).await;
        assert_eq!(listed.map_or_else(|error| error.code, |_| Code::Ok), code);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn tls_handshake_and_silence_after_it_end_in_time() {
    let (authority, files) = (Authority::new(), Files::new());
    let receive_time_max = Duration::from_millis(300);
    let access = files.tls(&authority.node(), None);
    let server = Server::with(Config { receive_time_max, access, ..Config::default() }).await;
    // The begin of a ClientHello that announces 512 bytes more.
    for begin in [&b""[..], b"\x16", b"\x16\x03\x01\x02\x00\x01"] {
        let mut stream = TcpStream::connect(server.address).await.unwrap();
        stream.write_all(begin).await.unwrap();
        let mut nothing = Vec::new();
        let read = stream.read_to_end(&mut nothing);
        let _ = timeout(Duration::from_secs(30), read).await.expect("the connection ends");
    }
    for protocol in [&b"h2"[..], b"http/1.1"] {
        let mut silent = encrypted(&server, &authority, protocol).await;
        let mut nothing = Vec::new();
        let read = silent.read_to_end(&mut nothing);
        let _ = timeout(Duration::from_secs(30), read).await.expect("the connection ends");
    }
    // Half of the preface of HTTP/2, and then nothing.
    let mut half = encrypted(&server, &authority, b"h2").await;
    half.write_all(b"PRI * HTTP/2.0").await.unwrap();
    let mut nothing = Vec::new();
    let read = half.read_to_end(&mut nothing);
    let _ = timeout(Duration::from_secs(30), read).await.expect("the connection ends");
    let client = server.client(credentials(&authority, None)).await.unwrap();
    assert!(client.is_serving().await.unwrap());
}

#[tokio::test(flavor = "multi_thread")]
async fn certificates_change_while_calls_run_and_a_bad_file_changes_nothing() {
    let (before, after, files) = (Authority::new(), Authority::new(), Files::new());
    let tokens = token_entry("watch", "vbar_watch", &[], "");
    let access = AccessOptions {
        credentials_poll: SOON,
        tokens_file: Some(files.write("tokens.toml", tokens)),
        ..files.tls(&before.node(), None)
    };
    let server = Server::start(access).await;
    let token = || Some("vbar_watch".to_owned());
    let of = |authority: &Authority| Credentials { token: token(), ..credentials(authority, None) };
    let open = server.client(of(&before)).await.unwrap();
    let calls = tokio::spawn({
        let open = open.clone();
        async move {
            loop {
                open.server_info().await.expect("an open connection goes on");
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        }
    });
    let reloads = async |outcome: &str| {
        let stream = encrypted(&server, &before, b"http/1.1").await;
        let request = "GET /metrics HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\
                       authorization: Bearer vbar_watch\r\n\r\n";
        let text = exchange(stream, request.as_bytes()).await.body;
        let name = format!("vbar_credential_reloads_total{{outcome=\"{outcome}\"}} ");
        let line = text.lines().find_map(|line| line.strip_prefix(&name).map(str::to_owned));
        line.map_or(0, |count| count.parse::<u64>().unwrap())
    };
    // A key that is not the certificate's, then no key at all.
    files.write("node.key", before.node().key);
    until("the wrong key is seen", async || reloads("refused").await == 1).await;
    std::fs::remove_file(files.path("node.key")).unwrap();
    until("the missing key is seen", async || reloads("refused").await == 2).await;
    assert!(server.client(of(&before)).await.is_ok());

    let new = after.node();
    files.write("node.key", &new.key);
    files.write("node.pem", &new.pem);
    until("the new certificate is shown", async || server.client(of(&after)).await.is_ok()).await;
    assert!(server.client(of(&before)).await.is_err());
    assert!(open.server_info().await.is_ok());
    assert!(!calls.is_finished(), "a call failed");
    calls.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn node_listens_beyond_this_machine_only_encrypted_and_asking_who_calls() {
    let (authority, files) = (Authority::new(), Files::new());
    let tokens_file = Some(files.write("tokens.toml", token_entry("a", "vbar_a", &["step"], "")));
    let tls = files.tls(&authority.node(), None);
    let only_tokens = AccessOptions { tokens_file: tokens_file.clone(), ..Default::default() };
    let listen = "0.0.0.0:0".parse().unwrap();
    for access in [AccessOptions::default(), only_tokens, tls.clone()] {
        let config = Config { listen, access, ..Config::default() };
        let Err(StartError::Config(faults)) = Node::start(config).await else {
            panic!("it started");
        };
        let named: Vec<_> = faults.iter().map(|fault| fault.setting).collect();
        assert_eq!(named, ["listen"]);
    }
    for access in
        [AccessOptions { tokens_file, ..tls }, files.tls(&authority.node(), Some(&authority))]
    {
        let node = Node::start(Config { listen, access, ..Config::default() }).await.unwrap();
        node.shutdown().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn credentials_that_cannot_be_read_are_all_named_at_the_start() {
    let (authority, files) = (Authority::new(), Files::new());
    let broken = AccessOptions {
        tls_client_ca: Some(files.write("ca.pem", "no certificate")),
        tls_key: Some(files.write("broken.key", "no key")),
        tokens_file: Some(files.write("tokens.toml", "[[token]]\nname = 'x'")),
        ..files.tls(&authority.node(), None)
    };
    let faults = Config { access: broken, ..Config::default() }.faults();
    let named: Vec<_> = faults.iter().map(|fault| fault.setting).collect();
    assert_eq!(named, ["tls_client_ca", "tls_key", "tokens_file"]);

    let alone = AccessOptions {
        tls_key: Some(files.path("broken.key")),
        tls_client_ca: Some(files.path("ca.pem")),
        audit_file: Some(files.path("no/audit.jsonl")),
        ..AccessOptions::default()
    };
    let faults = Config { access: alone, ..Config::default() }.faults();
    assert!(faults.iter().all(|fault| fault.setting == "tls_certificate"), "{faults:?}");

    let audit_file = Some(files.path("no/audit.jsonl"));
    let config =
        Config { access: AccessOptions { audit_file, ..Default::default() }, ..Default::default() };
    let Err(StartError::Config(faults)) = Node::start(config).await else {
        panic!("it started");
    };
    assert_eq!(faults[0].setting, "audit_file");
}
