//! What this program was built from.

use vbar_proto::v1;

/// What a program was built from, and with what.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Build {
    /// Version of the program.
    pub version: &'static str,
    /// Commit of its sources; empty if the build was not told.
    pub commit: &'static str,
    /// The compiler with its version.
    pub rustc: &'static str,
    /// Kind of machine it runs on.
    pub target: &'static str,
    /// `debug` or `release`.
    pub profile: &'static str,
    /// Names of its optional parts, with commas between.
    pub features: &'static str,
    /// Hex sha256 of sources, versions of dependencies, compiler and its options: equal for the
    /// same build, so that the same request has the same bytes.
    pub sha256: &'static str,
}

/// This program's.
pub const BUILD: Build = Build {
    version: env!("CARGO_PKG_VERSION"),
    commit: env!("VBAR_BUILT_COMMIT"),
    rustc: env!("VBAR_BUILT_RUSTC"),
    target: env!("VBAR_BUILT_TARGET"),
    profile: env!("VBAR_BUILT_PROFILE"),
    features: env!("VBAR_BUILT_FEATURES"),
    sha256: env!("VBAR_BUILT_SHA256"),
};

impl Build {
    /// The same as a message of the contract.
    #[must_use]
    pub fn message(&self) -> v1::Build {
        let features = self.features.split(',').filter(|feature| !feature.is_empty());
        v1::Build {
            version: self.version.to_owned(),
            commit: self.commit.to_owned(),
            rustc: self.rustc.to_owned(),
            target: self.target.to_owned(),
            profile: self.profile.to_owned(),
            features: features.map(str::to_owned).collect(),
            sha256: self.sha256.to_owned(),
        }
    }
}
