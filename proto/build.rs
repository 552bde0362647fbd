//! Compiles the `.proto` files with `protox`, so that no `protoc` is needed on the machine.

use std::{env, fs, path::PathBuf};

use prost::Message as _;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    const FILES: [&str; 4] = [
        "vbar/v1/service.proto",
        "google/longrunning/operations.proto",
        "google/rpc/error_details.proto",
        "google/rpc/status.proto",
    ];
    for folder in ["vbar", "google"] {
        println!("cargo:rerun-if-changed={folder}");
    }
    let mut compiler = protox::Compiler::new(["."])?;
    compiler.include_imports(true).include_source_info(true).open_files(FILES)?;
    let out = PathBuf::from(env::var("OUT_DIR")?);
    // With comments: the OpenAPI document is made from them.
    fs::write(out.join("descriptors.bin"), compiler.encode_file_descriptor_set())?;
    let set = tonic_prost_build::FileDescriptorSet::decode(
        compiler.encode_file_descriptor_set().as_slice(),
    )?;
    let mut messages = tonic_prost_build::Config::new();
    messages.enable_type_names().type_name_domain(["."], "type.googleapis.com").bytes(["."]);
    tonic_prost_build::configure()
        .codec_path("crate::StrictCodec")
        .compile_fds_with_config(set, messages)?;
    Ok(())
}
