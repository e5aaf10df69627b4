"""The Dockerfile: locked packages alone, files that exist, a user that is not root."""

import re

from support.scripts import ROOT

LINES = re.sub(r"\\\n\s*", "", (ROOT / "Dockerfile").read_text("utf-8")).splitlines()
#: Stages that are given to users.
GIVEN = ("cli", "node")


def instructions() -> list[tuple[str, str, str]]:
    """Stage, instruction and arguments of each line."""
    stage, found = "", []
    for line in LINES:
        word, _, rest = line.partition(" ")
        if word == "FROM":
            stage = rest.rpartition(" AS ")[2]
        if word.isupper():
            found.append((stage, word, rest))
    return found


def test_every_installed_requirement_is_locked_with_its_hash() -> None:
    installs = [
        part
        for _, word, rest in instructions()
        if word == "RUN"
        for part in rest.split("&&")
        if "pip install" in part
    ]
    assert len(installs) >= 6
    for each in installs:
        assert "--require-hashes -r" in each or "--no-deps --no-build-isolation" in each
    assert not any("test.txt" in each or "dev.txt" in each for each in installs)


def test_copied_files_exist_and_are_sent_to_the_builder() -> None:
    sent = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text("utf-8").splitlines()
        if line.startswith("!")
    }
    copied = [
        source
        for _, word, rest in instructions()
        if word == "COPY" and "--from=" not in rest
        for source in rest.split()[:-1]
    ]
    assert len(copied) > 10
    for source in copied:
        assert (ROOT / source).exists(), source
        assert source.partition("/")[0] in sent


def test_the_images_run_as_a_user_that_is_not_root() -> None:
    for stage in GIVEN:
        users = [
            rest for at, word, rest in instructions() if at == stage and word == "USER"
        ]
        assert users == ["fgtrack"]
        last = [word for at, word, _ in instructions() if at == stage]
        assert last.index("USER") < last.index("ENTRYPOINT")
        assert "RUN" not in last[last.index("USER") :]
