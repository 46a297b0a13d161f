//! The bridge between Zenoh and ROS 2 over DDS: the published plugin `zenoh-plugin-ros2dds` with a `main` of its own.
//!
//! Usage: `fmu-mesh-ros2dds CONFIG.json5`. The file is a Zenoh configuration with a section `plugins: {ros2dds: {…}}`.
//! It prints `ready` once the plugin runs, and ends when its standard input is closed, on SIGINT or on SIGTERM: a parent
//! that holds its standard input never leaves it behind. Exit codes: 0 ended when asked, 1 failed, 2 wrong usage.

use std::io::Read;
use std::process::ExitCode;

use tokio::signal::unix::{signal, SignalKind};
use tokio::sync::oneshot;
use zenoh::internal::{plugins::PluginsManager, runtime::RuntimeBuilder};
use zenoh::{Config, Result};
use zenoh_config::ModeDependentValue;
use zenoh_plugin_ros2dds::ROS2Plugin;

const PLUGIN: &str = "ros2dds";

#[tokio::main]
async fn main() -> ExitCode {
    zenoh::init_log_from_env_or("error");
    let mut arguments = std::env::args().skip(1);
    let (Some(file), None) = (arguments.next(), arguments.next()) else {
        eprintln!("usage: fmu-mesh-ros2dds CONFIG.json5");
        return ExitCode::from(2);
    };
    let config = match configuration(&file) {
        Ok(config) => config,
        Err(error) => {
            eprintln!("'{file}' is no configuration of the bridge: {error}");
            return ExitCode::from(2);
        }
    };
    match bridge(config).await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("the bridge failed: {error}");
            ExitCode::FAILURE
        }
    }
}

fn configuration(file: &str) -> Result<Config> {
    let mut config = Config::from_file(file)?;
    if config.plugin(PLUGIN).is_none() {
        return Err(format!("it has no section plugins: {{{PLUGIN}: {{}}}}").into());
    }
    // The plugin's cache for transient-local topics sorts by time stamps, and it is asked and configured by the admin space.
    config
        .timestamping
        .set_enabled(Some(ModeDependentValue::Unique(true)))
        .map_err(|_| "timestamping cannot be enabled")?;
    config.adminspace.set_enabled(true).map_err(|_| "the admin space cannot be enabled")?;
    config.plugins_loading.set_enabled(true).map_err(|_| "plugins cannot be enabled")?;
    Ok(config)
}

async fn bridge(config: Config) -> Result<()> {
    let mut plugins = PluginsManager::static_plugins_only();
    plugins.declare_static_plugin::<ROS2Plugin, &str>(PLUGIN, true);
    let mut runtime = RuntimeBuilder::new(config).plugins_manager(plugins).build().await?;
    runtime.start().await?;
    println!("ready");
    asked_to_end().await?;
    runtime.close().await
}

/// Waits for SIGINT, SIGTERM or the end of standard input.
async fn asked_to_end() -> Result<()> {
    let mut interrupt = signal(SignalKind::interrupt())?;
    let mut terminate = signal(SignalKind::terminate())?;
    let (close, closed) = oneshot::channel::<()>();
    // A thread of its own: the runtime would wait for a blocking task before it ends.
    std::thread::spawn(move || {
        while matches!(std::io::stdin().read(&mut [0; 64]), Ok(1..)) {}
        drop(close);
    });
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
        _ = closed => {}
    }
    Ok(())
}
