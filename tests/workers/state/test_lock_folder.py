"""Locks of two commands on one folder that end and begin at the same time."""

from workers.state.lock import FileLock


def test_a_lock_ends_although_another_command_writes_into_its_folder(tmp_path, monkeypatch):
    folder = tmp_path / ".work"
    lock = FileLock(folder / "lock")
    unlink = type(tmp_path).unlink

    def unlink_and_go_on(path, *arguments):
        unlink(path, *arguments)
        (folder / "other").touch()  # what the next command does before the folder is removed

    with lock:
        monkeypatch.setattr(type(tmp_path), "unlink", unlink_and_go_on)
    assert (folder / "other").exists()
    monkeypatch.undo()
    with FileLock(folder / "lock"):
        pass
