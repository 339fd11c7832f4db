"""`socast secure` keeps keys for their owner, overwrites nothing, and reports each mistake in one line."""

import json
import stat
import sys
from datetime import UTC, datetime, timedelta

import pytest

from socast.tools.security.access import SERVICES
from socast.tools.security.folder import SecureFolder
from tests.support.commands import called, done, refused


@pytest.fixture
def folder(tmp_path):
    done("secure", "init", tmp_path / "keys", "--router", "router.example", "--car", "taxi-1", "--prefix", "montreal")
    return tmp_path / "keys"


def read_all(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def accepted(folder):
    """Return the common names that the router accepts."""
    subjects = json.loads((folder / "router.json5").read_text())["access_control"]["subjects"]
    return {name for subject in subjects for name in subject["cert_common_names"]}


def records(folder):
    out, _, _ = called("secure", "list", folder, "--json", "-")
    return json.loads(out)["certificates"]


def test_files_with_keys_are_for_their_owner_only(folder):
    done("secure", "add", folder, "--car", "taxi-2")
    done("secure", "renew", folder, "taxi-1", "router")
    secret = [
        path for path, content in read_all(folder).items() if b"PRIVATE KEY" in content or b"private_key" in content
    ]
    assert {path.name for path in secret} >= {"authority.key", "router.json5", "taxi-1.json5", "taxi-2.json5"}
    assert {stat.S_IMODE(path.stat().st_mode) for path in secret} == {0o600}
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    assert {stat.S_IMODE(path.stat().st_mode) for path in folders} == {0o700}


def test_no_command_loses_the_content_of_a_file(folder, capsys):
    commands = (
        ("add", folder, "--car", "taxi-2"),
        ("renew", folder, "taxi-1", "dispatch", "router"),
        ("renew", folder, "taxi-1", "--revoke"),
        ("revoke", folder, "taxi-2"),
    )
    for command in commands:
        before = read_all(folder)
        done("secure", *command)
        assert set(before.values()) <= set(read_all(folder).values()), command
    before = read_all(folder)
    assert "is not empty, and nothing in it is overwritten; name a new folder" in refused(
        capsys, "secure", "init", folder
    )
    assert "taxi-1 has a certificate; " in refused(capsys, "secure", "add", folder, "--car", "taxi-1")
    assert read_all(folder) == before


def test_router_accepts_the_certificates_in_force_and_no_others(folder):
    services = {f"{name}/1" for name in SERVICES}
    assert accepted(folder) == {*services, "taxi-1/1"}
    done("secure", "add", folder, "--car", "taxi-2", "--car", "taxi-3")
    done("secure", "renew", folder, "taxi-2")
    done("secure", "renew", folder, "taxi-3", "--revoke")
    done("secure", "revoke", folder, "taxi-1")
    assert accepted(folder) == {*services, "taxi-2/1", "taxi-2/2", "taxi-3/2"}
    done("secure", "add", folder, "--car", "taxi-1")
    assert "taxi-1/2" in accepted(folder), "a certificate that was revoked is in force again"
    assert "taxi-1/1" not in accepted(folder)


def test_gateway_sends_batches_alone_and_no_car_sends_any(folder):
    done("secure", "add", folder, "--gateway", "depot-3")
    assert (folder / "gateways" / "depot-3.json5").exists()
    rules = json.loads((folder / "router.json5").read_text())["access_control"]["rules"]
    puts = [rule for rule in rules if "put" in rule["messages"] and "ingress" in rule["flows"]]
    batches = {rule["id"].partition(":")[0]: rule["key_exprs"] for rule in puts if "batch" in str(rule["key_exprs"])}
    key = "montreal/fleet/depot-3/batch"
    assert batches == {"gateway depot-3": [key, f"{key}/@adv/**"]}
    done("secure", "renew", folder, "gateway depot-3")
    assert {"gateway depot-3/1", "gateway depot-3/2"} <= accepted(folder)


def test_router_file_has_a_line_for_each_rule(folder):
    text = (folder / "router.json5").read_text()
    rules = json.loads(text)["access_control"]["rules"]
    lines = [json.loads(line.strip().rstrip(",")) for line in text.splitlines() if '"permission"' in line]
    assert lines == rules


def test_own_settings_in_the_files_stay(folder):
    for name in ("router.json5", "cars/taxi-1.json5"):
        settings = json.loads((folder / name).read_text())
        (folder / name).write_text(json.dumps(settings | {"metadata": {"depot": "north"}}))
    done("secure", "renew", folder, "taxi-1", "router")
    for name in ("router.json5", "cars/taxi-1.json5"):
        assert json.loads((folder / name).read_text())["metadata"] == {"depot": "north"}


def test_list_shows_what_expires_and_renew_replaces_it(folder, capsys):
    SecureFolder(folder, clock=lambda: datetime.now(UTC) - timedelta(days=355)).add(["taxi-2"])
    SecureFolder(folder, clock=lambda: datetime.now(UTC) - timedelta(days=366)).add(["taxi-3"])
    done("secure", "list", folder)
    rows = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}
    assert rows["taxi-2"].split()[-2:] == ["renew", "it"]
    assert rows["taxi-3"].split()[-1] == "expired"
    assert "renew" not in rows["taxi-1"]
    assert {each["name"] for each in records(folder) if each["due"]} == {"taxi-2", "taxi-3"}
    done("secure", "renew", folder)
    assert "renewed: taxi-2, taxi-3\n" in capsys.readouterr().out
    now = {(each["name"], each["issue"]): each for each in records(folder)}
    assert not any(each["due"] for each in now.values())
    assert ("taxi-2", 1) in now, "the router refuses a certificate that is still valid"
    assert ("taxi-3", 1) not in now
    done("secure", "renew", folder)
    assert "nothing expires within 30 days" in capsys.readouterr().out


def test_certificates_name_the_hosts_of_the_router_only(tmp_path):
    done("secure", "init", tmp_path / "keys", "--router", "router.example", "--router", "10.0.0.5", "--router", "::1")
    hosts = {each["name"]: each["hosts"] for each in records(tmp_path / "keys")}
    assert hosts == {"router": ["router.example", "10.0.0.5", "::1"], "consumer": [], "dispatch": [], "weather": []}
    client = json.loads((tmp_path / "keys" / "consumer.json5").read_text())
    assert client["connect"]["endpoints"] == ["tls/router.example:7447", "tls/10.0.0.5:7447", "tls/[::1]:7447"]


def test_cars_come_from_a_file(tmp_path):
    (tmp_path / "cars.txt").write_text("taxi-1\n\n# the night shift\ntaxi-2  # spare\n")
    done("secure", "init", tmp_path / "keys", "--cars", tmp_path / "cars.txt", "--car", "taxi-3", "--car", "taxi-1")
    assert sorted(path.stem for path in (tmp_path / "keys" / "cars").iterdir()) == ["taxi-1", "taxi-2", "taxi-3"]


def test_key_of_the_authority_may_be_kept_elsewhere(folder, tmp_path, capsys):
    (folder / "authority" / "authority.key").rename(tmp_path / "vault.key")
    message = refused(capsys, "secure", "add", folder, "--car", "taxi-2")
    assert "authority.key: No such file or directory; name the file where you keep it with --authority-key" in message
    done("secure", "add", folder, "--car", "taxi-2", "--authority-key", tmp_path / "vault.key")
    done("secure", "init", tmp_path / "other")
    wrong = tmp_path / "other" / "authority" / "authority.key"
    assert "is not the key of" in refused(capsys, "secure", "renew", folder, "taxi-1", "--authority-key", wrong)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--car", "a/b"), "--car is 'a/b'; give 1 to 58 letters"),
        (("--car", "x" * 59), "give 1 to 58 letters"),
        (("--car", "router"), "none of router, consumer, dispatch, weather"),
        (("--car", ".."), "--car is '..'"),
        (("--router", "tcp/router:7447"), "--router is 'tcp/router:7447'; give a host name or an address"),
        (("--prefix", "a/**"), "give plain chunks"),
        (("--cars", "/nowhere"), "/nowhere cannot be read"),
    ],
)
def test_wrong_value_is_refused_and_nothing_is_written(tmp_path, capsys, options, words):
    assert words in refused(capsys, "secure", "init", tmp_path / "keys", *options)
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("renew", "taxi-7"), "'taxi-7' has no certificate in"),
        (("revoke", "taxi-7"), "'taxi-7' has no certificate in"),
        (("revoke", "router"), "the router cannot be revoked"),
        (("renew", "router", "--revoke"), "cannot be revoked"),
        (("renew", "--revoke"), "--revoke needs the names"),
        (("revoke",), "no name is given"),
        (("add",), "no car is given"),
    ],
)
def test_impossible_change_is_refused_and_changes_nothing(folder, capsys, command, words):
    before = read_all(folder)
    name, *options = command
    assert words in refused(capsys, "secure", name, folder, *options)
    assert read_all(folder) == before


def test_folder_of_something_else_is_refused(tmp_path, capsys):
    assert f"make one with: socast secure init {tmp_path}" in refused(capsys, "secure", "list", tmp_path)


def test_router_file_with_comments_is_refused(folder, capsys):
    (folder / "router.json5").write_text("{ /* mine */ }")
    assert "is not plain JSON" in refused(capsys, "secure", "add", folder, "--car", "taxi-2")


def test_missing_package_is_named_with_its_remedy(monkeypatch, capsys, tmp_path):
    for name in [
        each for each in sys.modules if each.startswith(("socast.tools.security", "socast.tools.commands.secure"))
    ]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    assert "pip install 'socast[service]'" in refused(capsys, "secure", "list", tmp_path)
