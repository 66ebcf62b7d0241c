//! Files that the user names: written whole where they can be, written into where something else is there.

use std::io::Write;
use std::path::{Path as FsPath, PathBuf};

use super::local::temporary_in;

/// The name of standard output among files.
pub const STANDARD_OUTPUT: &str = "-";
/// Other names that systems have for it.
const STANDARD_OUTPUT_PATHS: [&str; 3] = ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"];
/// Symbolic links that are followed to one file, as many as Linux follows.
const MAX_LINKS: usize = 40;

/// Returns whether a file's name stands for standard output.
pub fn is_standard_output(path: &FsPath) -> bool {
    path == FsPath::new(STANDARD_OUTPUT)
        || STANDARD_OUTPUT_PATHS.iter().any(|known| path == FsPath::new(known))
}

/// Where bytes for a name end up.
#[derive(Debug, PartialEq, Eq)]
enum OutputTarget {
    StandardOutput,
    /// A regular file, or none yet; links are resolved.
    File(PathBuf),
    /// A pipe, a device, or a file that this process has open.
    Stream(PathBuf),
}

impl OutputTarget {
    /// Follows a name to what it stands for.
    fn of(path: &FsPath) -> std::io::Result<Self> {
        if is_standard_output(path) {
            return Ok(Self::StandardOutput);
        }
        let mut path = std::path::absolute(path)?;
        for _ in 0..MAX_LINKS {
            let kind = match std::fs::symlink_metadata(&path) {
                Ok(found) => found.file_type(),
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(Self::File(path)),
                Err(e) => return Err(e),
            };
            if kind.is_file() {
                return Ok(Self::File(path));
            }
            if kind.is_dir() {
                let reason = "is a folder; name a file in it";
                return Err(std::io::Error::new(std::io::ErrorKind::IsADirectory, reason));
            }
            if !kind.is_symlink() {
                return Ok(Self::Stream(path));
            }
            let folder = path.parent().unwrap_or(FsPath::new("/")).canonicalize()?;
            if is_descriptor_folder(&folder) {
                return Ok(Self::Stream(path));
            }
            path = folder.join(std::fs::read_link(&path)?);
        }
        let reason = "is a symbolic link to itself; remove it";
        Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, reason))
    }
}

/// Returns whether a folder lists what a process has open: links there lead to no names of files.
fn is_descriptor_folder(folder: &FsPath) -> bool {
    let is_fd = folder.file_name().is_some_and(|name| name == "fd");
    folder.starts_with("/proc") && is_fd || folder == FsPath::new("/dev/fd")
}

/// Writes a local file, whole or not at all, replacing what was there and keeping its permissions.
///
/// Symbolic links are followed; pipes and devices are written to, and `-` is standard output.
///
/// # Errors
/// The error of the file system or of `write`; the old file is untouched then.
pub fn write_file(
    path: &FsPath,
    write: impl FnOnce(&mut dyn Write) -> std::io::Result<()>,
) -> std::io::Result<()> {
    match OutputTarget::of(path)? {
        OutputTarget::File(path) => {
            let folder = path.parent().unwrap_or(FsPath::new("."));
            let mut out = std::io::BufWriter::new(temporary_in(folder)?);
            write(&mut out)?;
            let file = out.into_inner().map_err(std::io::IntoInnerError::into_error)?;
            publish(&path, file)
        }
        target => {
            let mut out = std::io::BufWriter::new(target.open()?);
            written(write(&mut out).and_then(|()| out.flush()))
        }
    }
}

/// Creates the temporary file for what [`replace_file`] will publish at `path`.
///
/// # Errors
/// The error of the file system.
pub fn temporary_beside(path: &FsPath) -> std::io::Result<tempfile::NamedTempFile> {
    match OutputTarget::of(path)? {
        OutputTarget::File(path) => temporary_in(path.parent().unwrap_or(FsPath::new("."))),
        OutputTarget::StandardOutput | OutputTarget::Stream(_) => tempfile::NamedTempFile::new(),
    }
}

/// Publishes a finished temporary file at `path`, as [`write_file`] does.
///
/// # Errors
/// The error of the file system; the old file is untouched then.
pub fn replace_file(path: &FsPath, file: tempfile::NamedTempFile) -> std::io::Result<()> {
    match OutputTarget::of(path)? {
        OutputTarget::File(path) => publish(&path, file),
        target => {
            let mut from = file.reopen()?;
            let mut out = target.open()?;
            written(std::io::copy(&mut from, &mut out).and_then(|_| out.flush()))
        }
    }
}

impl OutputTarget {
    /// Opens what is no regular file; nothing is cut or made.
    fn open(self) -> std::io::Result<Box<dyn Write>> {
        match self {
            Self::StandardOutput => Ok(Box::new(std::io::stdout())),
            Self::File(path) | Self::Stream(path) => {
                Ok(Box::new(std::fs::File::options().append(true).open(path)?))
            }
        }
    }
}

/// A reader that has read enough is no error.
fn written(result: std::io::Result<()>) -> std::io::Result<()> {
    match result {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        written => written,
    }
}

fn publish(path: &FsPath, file: tempfile::NamedTempFile) -> std::io::Result<()> {
    // A file that was closed to others stays so.
    if let Ok(there) = std::fs::metadata(path) {
        file.as_file().set_permissions(there.permissions())?;
    }
    file.as_file().sync_all()?;
    file.persist(path).map(|_| ()).map_err(|e| e.error)
}

#[cfg(all(test, unix))]
mod tests {
    use std::os::unix::fs::{PermissionsExt as _, symlink};

    use super::*;

    fn text(path: &FsPath, text: &str) -> std::io::Result<()> {
        write_file(path, |out| out.write_all(text.as_bytes()))
    }

    fn mode(path: &FsPath) -> u32 {
        std::fs::metadata(path).unwrap().permissions().mode() & 0o777
    }

    #[test]
    fn a_link_stays_and_its_target_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("a")).unwrap();
        std::fs::write(at("a/target"), "old").unwrap();
        symlink("a/target", at("link")).unwrap();
        symlink("link", at("link of a link")).unwrap();
        symlink("a/not yet", at("dangling")).unwrap();
        text(&at("link of a link"), "new").unwrap();
        text(&at("dangling"), "made").unwrap();
        assert!(std::fs::symlink_metadata(at("link")).unwrap().is_symlink());
        assert_eq!(std::fs::read_to_string(at("a/target")).unwrap(), "new");
        assert_eq!(std::fs::read_to_string(at("a/not yet")).unwrap(), "made");
        let file = temporary_beside(&at("link")).unwrap();
        assert_eq!(file.path().parent(), Some(at("a").canonicalize().unwrap().as_path()));
        std::fs::write(file.path(), "newest").unwrap();
        replace_file(&at("link"), file).unwrap();
        assert_eq!(std::fs::read_to_string(at("link of a link")).unwrap(), "newest");
        symlink("itself", at("itself")).unwrap();
        let error = text(&at("itself"), "x").unwrap_err();
        assert_eq!(error.to_string(), "is a symbolic link to itself; remove it");
        assert_eq!(text(&at("a"), "x").unwrap_err().to_string(), "is a folder; name a file in it");
    }

    #[test]
    fn permissions_of_a_file_that_is_there_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("secret");
        std::fs::write(&path, "old").unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o640)).unwrap();
        text(&path, "new").unwrap();
        assert_eq!((mode(&path), std::fs::read_to_string(&path).unwrap().as_str()), (0o640, "new"));
    }

    #[test]
    fn what_a_process_has_open_is_no_name_of_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = std::fs::File::create(folder.path().join("x")).unwrap();
        let path = format!("/dev/fd/{}", std::os::fd::AsRawFd::as_raw_fd(&file));
        if FsPath::new(&path).exists() {
            assert!(matches!(
                OutputTarget::of(FsPath::new(&path)).unwrap(),
                OutputTarget::Stream(_)
            ));
            text(FsPath::new(&path), "into it").unwrap();
            assert_eq!(std::fs::read_to_string(folder.path().join("x")).unwrap(), "into it");
        }
        assert!(is_standard_output(FsPath::new("-")));
        assert!(is_standard_output(FsPath::new("/dev/stdout")));
        assert!(!is_standard_output(FsPath::new("./-")));
    }
}
