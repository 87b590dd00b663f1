"""Paths with links in them."""

from torchrefrac.files.paths import real_path


def test_links_are_followed_as_far_as_they_lead(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there")
    (tmp_path / "loop").symlink_to("loop")

    assert real_path("link/new.json") == tmp_path.resolve() / "there" / "new.json"
    assert real_path("loop") == tmp_path.resolve() / "loop"
