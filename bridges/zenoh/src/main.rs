//! The bridge between Zenoh and MQTT and HTTP: the published plugins `zenoh-plugin-mqtt` and `zenoh-plugin-rest` with a
//! `main` of their own.
//!
//! Usage: `fmu-mesh-zenoh-bridge CONFIG.json5`. The file is a Zenoh configuration with a section
//! `plugins: {mqtt: {port: "ADDRESS:PORT"}, rest: {http_port: "ADDRESS:PORT"}}`, or with one of the two.
//! It prints a line for each port as soon as it accepts connections, and `ready` once it is linked to what it connects to. It
//! ends on SIGINT, on SIGTERM, or when its standard input is a pipe and is closed: a parent that holds this pipe never leaves
//! it behind. Exit codes: 0 ended when asked, 1 failed, 2 wrong usage.

use std::io::Read;
use std::net::{SocketAddr, TcpListener};
use std::os::unix::fs::FileTypeExt;
use std::process::ExitCode;
use std::time::Duration;

use tokio::net::TcpStream;
use tokio::signal::unix::{signal, SignalKind};
use tokio::sync::oneshot;
use tokio::time::{interval, timeout};
use zenoh::internal::{
    plugins::PluginsManager,
    runtime::{Runtime, RuntimeBuilder},
};
use zenoh::{Config, Result};
use zenoh_config::ModeDependentValue;
use zenoh_plugin_mqtt::MqttPlugin;
use zenoh_plugin_rest::RestPlugin;

const MQTT: &str = "mqtt";
const REST: &str = "rest";
/// Where a plugin reads its address.
const KEYS: [(&str, &str); 2] = [(MQTT, "port"), (REST, "http_port")];
const START_DEADLINE: Duration = Duration::from_secs(10);

fn main() -> ExitCode {
    zenoh::init_log_from_env_or("error");
    let mut arguments = std::env::args().skip(1);
    let (Some(file), None) = (arguments.next(), arguments.next()) else {
        eprintln!("usage: fmu-mesh-zenoh-bridge CONFIG.json5");
        return ExitCode::from(2);
    };
    let (config, addresses) = match configuration(&file) {
        Ok(found) => found,
        Err(error) => {
            eprintln!("'{file}' is no configuration of the bridge: {error}");
            return ExitCode::from(2);
        }
    };
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().expect("threads can be started");
    let done = runtime.block_on(bridge(config, &addresses));
    // The servers of the plugins have no end of their own; nothing is left to do that they could lose.
    runtime.shutdown_background();
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("the bridge failed: {error}");
            ExitCode::FAILURE
        }
    }
}

fn configuration(file: &str) -> Result<(Config, Vec<(&'static str, SocketAddr)>)> {
    let mut config = Config::from_file(file)?;
    let mut addresses = Vec::new();
    for (plugin, key) in KEYS {
        let Some(section) = config.plugin(plugin) else { continue };
        // A number alone, or nothing, would be a port on all interfaces of the host: that has to be written.
        let address =
            section.get(key).and_then(|found| found.as_str()).and_then(|text| text.parse().ok()).ok_or_else(|| {
                format!("plugins/{plugin}/{key} has to be \"ADDRESS:PORT\", for instance \"127.0.0.1:8000\"")
            })?;
        addresses.push((plugin, address));
    }
    if addresses.is_empty() {
        return Err("it has no section plugins: {mqtt: {}, rest: {}}".into());
    }
    // MQTT has no time stamps: with this, values get the time at which they came to the bridge.
    config
        .timestamping
        .set_enabled(Some(ModeDependentValue::Unique(true)))
        .map_err(|_| "timestamping cannot be enabled")?;
    config.plugins_loading.set_enabled(true).map_err(|_| "plugins cannot be enabled")?;
    Ok((config, addresses))
}

async fn bridge(config: Config, addresses: &[(&'static str, SocketAddr)]) -> Result<()> {
    let mut plugins = PluginsManager::static_plugins_only();
    for (plugin, address) in addresses {
        // The plugin of MQTT only logs that somebody else has the port.
        TcpListener::bind(address).map_err(|error| format!("{plugin} cannot listen on {address}: {error}"))?;
        match *plugin {
            MQTT => plugins.declare_static_plugin::<MqttPlugin, &str>(MQTT, false),
            _ => plugins.declare_static_plugin::<RestPlugin, &str>(REST, false),
        }
    }
    let mut runtime = RuntimeBuilder::new(config).plugins_manager(plugins).build().await?;
    if runtime.plugins_manager().started_plugins_iter().count() < addresses.len() {
        return Err("a plugin did not start".into());
    }
    for (plugin, address) in addresses {
        timeout(START_DEADLINE, accepted(*address))
            .await
            .map_err(|_| format!("{plugin} does not answer on {address} within {START_DEADLINE:?}"))?;
        println!("{plugin} listens on {address}");
    }
    tokio::select! {
        asked = asked_to_end() => asked?,
        failed = started(&mut runtime) => failed?,
    }
    runtime.close().await
}

/// A client returns from its start only when it has found the mesh, which may never come.
async fn started(runtime: &mut Runtime) -> Result<()> {
    runtime.start().await?;
    println!("ready");
    std::future::pending().await
}

/// Returns once somebody accepts connections there.
async fn accepted(address: SocketAddr) {
    let mut tries = interval(Duration::from_millis(10));
    loop {
        tries.tick().await;
        if TcpStream::connect(address).await.is_ok() {
            return;
        }
    }
}

/// Waits for SIGINT, SIGTERM or the end of a pipe at standard input; a service has /dev/null there.
async fn asked_to_end() -> Result<()> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let (close, closed) = oneshot::channel::<()>();
    let mut close = Some(close);
    if std::fs::metadata("/dev/stdin").is_ok_and(|found| found.file_type().is_fifo()) {
        let close = close.take();
        // A thread of its own: the runtime would wait for a blocking task before it ends.
        std::thread::spawn(move || {
            while matches!(std::io::stdin().read(&mut [0; 64]), Ok(1..)) {}
            drop(close);
        });
    }
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
        _ = closed => {}
    }
    Ok(())
}
