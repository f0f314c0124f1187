import os
import resource
import signal
import stat
import subprocess
import sys
import textwrap
import time

import pytest

from sb3_causalgdp.files import MARK, remove_folder, renamed_when_done, replaced_when_done, saved_when_done, temporary_folder


def left_in(folder):
    return [path for path in folder.rglob("*") if path.name.startswith(MARK)]


def test_a_file_is_the_old_one_until_the_new_one_is_complete(tmp_path):
    path = tmp_path / "folder" / "file.txt"
    with replaced_when_done(path) as temporary:
        temporary.write_text("old")
        assert temporary.suffix == ".txt" and not path.exists()
    with pytest.raises(KeyError), replaced_when_done(path) as temporary:
        temporary.write_text("half")
        raise KeyError
    assert path.read_text() == "old" and os.listdir(path.parent) == ["file.txt"]


def test_a_link_stays_a_link_and_the_mode_is_kept(tmp_path):
    target, link = tmp_path / "target", tmp_path / "link"
    target.write_text("old")
    target.chmod(0o640)
    link.symlink_to("target")
    with replaced_when_done(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink() and target.read_text() == "new"
    assert stat.S_IMODE(target.stat().st_mode) == 0o640


def test_new_files_have_the_mode_that_others_have(tmp_path):
    (tmp_path / "plain").write_text("")
    with replaced_when_done(tmp_path / "file") as temporary:
        temporary.write_text("")
    assert (tmp_path / "file").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_folder_is_complete_or_not_there(tmp_path):
    with pytest.raises(KeyError), renamed_when_done(tmp_path / "folder") as filled:
        (filled / "part").write_text("one")
        raise KeyError
    assert os.listdir(tmp_path) == []
    with renamed_when_done(tmp_path / "folder") as filled:
        (filled / "part").write_text("one")
        assert not (tmp_path / "folder").exists()
    assert (tmp_path / "folder" / "part").read_text() == "one"
    with pytest.raises(FileExistsError), renamed_when_done(tmp_path / "folder"):
        pass
    remove_folder(tmp_path / "folder")
    assert os.listdir(tmp_path) == []


def test_file_like_objects_are_given_back_and_paths_get_their_suffix(tmp_path):
    stream = object()
    with saved_when_done(stream, ".zip") as given:
        assert given is stream
    with saved_when_done(str(tmp_path / "model"), ".zip") as given:
        given.write_text("")
    assert os.listdir(tmp_path) == ["model.zip"]


def run(code, folder, **kwargs):
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=folder, stderr=subprocess.PIPE, text=True, **kwargs
    )
    return process


WRITER = """
    import time
    from pathlib import Path
    from sb3_causalgdp.files import replaced_when_done, temporary_folder
    with replaced_when_done("file") as temporary, temporary_folder(Path()) as folder:
        temporary.write_text("half")
        Path("ready").write_text("")
        time.sleep(60)
"""


def test_what_a_killed_process_left_goes_with_the_next_writing_and_not_before_its_end(tmp_path):
    process = run(WRITER, tmp_path)
    while not (tmp_path / "ready").exists():
        time.sleep(0.01)
    with replaced_when_done(tmp_path / "file") as temporary, temporary_folder(tmp_path):
        temporary.write_text("new")
    # Those of the process that is still writing
    assert len(left_in(tmp_path)) == 2
    process.send_signal(signal.SIGKILL)
    process.wait()
    with replaced_when_done(tmp_path / "other") as temporary:
        temporary.write_text("other")
    assert len(left_in(tmp_path)) == 2
    with replaced_when_done(tmp_path / "file") as temporary, temporary_folder(tmp_path):
        temporary.write_text("newer")
    assert left_in(tmp_path) == [] and (tmp_path / "file").read_text() == "newer"


def test_a_file_that_grows_too_large_leaves_the_old_one(tmp_path):
    (tmp_path / "file").write_text("old")
    code = """
        from sb3_causalgdp.files import replaced_when_done
        with replaced_when_done("file") as temporary:
            temporary.write_bytes(bytes(100_000))
    """

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))

    process = run(code, tmp_path, preexec_fn=limit)
    _, errors = process.communicate()
    assert process.returncode == 1 and "File too large" in errors.splitlines()[-1]
    assert os.listdir(tmp_path) == ["file"] and (tmp_path / "file").read_text() == "old"
