import huggingface_hub.utils
import pytest
import tiny
import torch
from hub_stub import Hub
from huggingface_hub import ModelCard, constants

from lerobot_latentsafe.checkpoint import CheckpointError
from lerobot_latentsafe.hub import HubUnreachableError, push_filter
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy, UntrainedFilterError


def point_to(monkeypatch, url, cache):
    """What HF_ENDPOINT and its fellows set when huggingface_hub is imported."""
    settings = {
        "ENDPOINT": url,
        "HUGGINGFACE_CO_URL_TEMPLATE": url + "/{repo_id}/resolve/{revision}/{filename}",
        "HF_HUB_OFFLINE": False,
        "HF_HUB_DISABLE_XET": True,
        "HF_HUB_DISABLE_TELEMETRY": True,
        "HF_HUB_CACHE": str(cache),
    }
    for name, value in settings.items():
        monkeypatch.setattr(constants, name, value)
    monkeypatch.setenv("HF_TOKEN", "hf_nobody")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    huggingface_hub.utils.close_session()


@pytest.fixture
def hub(monkeypatch, tmp_path):
    with Hub() as hub:
        point_to(monkeypatch, hub.url, tmp_path / "cache")
        yield hub


@pytest.fixture
def no_hub(monkeypatch, tmp_path):
    """A port on which nobody answers."""
    with Hub() as closed:
        url = closed.url
    point_to(monkeypatch, url, tmp_path / "cache")


def contents(folder):
    return {file.relative_to(folder): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def assert_same_decisions(first, second):
    driven = []
    for policy in (first, second):
        torch.manual_seed(0)
        driven.append(tiny.drive(policy))
    for a, b in zip(*driven):
        torch.testing.assert_close(a.action, b.action, rtol=0, atol=0)
        torch.testing.assert_close(a.value, b.value, rtol=0, atol=0)


def test_pulled_filter_decides_as_the_pushed_one(hub, policy):
    policy.config.epsilon = 0.03
    url = push_filter(policy, "me/filter", "me/car")
    assert url == f"{hub.url}/me/filter"
    pulled = LatentSafePolicy.from_pretrained("me/filter")
    assert pulled.config.epsilon == 0.03
    assert_same_decisions(policy, pulled)


def test_pushed_folder_holds_what_lerobots_commands_need(hub, policy):
    push_filter(policy, "me/filter", "me/car")
    expected = {
        "README.md", "config.json", "integrity.json", "model.safetensors", "policy_preprocessor.json",
        "policy_postprocessor.json",
    }  # fmt: skip
    assert set(hub.repos["me/filter"]) - {".gitattributes"} == expected


def test_shielded_policy_travels_with_its_base(hub, policy, tiny_diffusion):
    policy.attach(tiny_diffusion)
    push_filter(policy, "me/shielded", "me/car")
    assert "base_policy/model.safetensors" in hub.repos["me/shielded"]
    pulled = LatentSafePolicy.from_pretrained("me/shielded")
    assert pulled.base.config.type == "diffusion" and "cache" in str(pulled.base.path)
    assert_same_decisions(policy, pulled)


def test_base_policy_may_come_from_the_hub(hub, policy, tiny_diffusion):
    hub.repos["me/diffusion"] = {str(name): content for name, content in contents(tiny_diffusion).items()}
    hub.commits["me/diffusion"] = ["a" * 40]
    policy.attach("me/diffusion")
    assert policy.base.config.type == "diffusion"


def test_pushing_again_replaces(hub, policy):
    push_filter(policy, "me/filter", "me/car")
    policy.config.epsilon = 0.5
    push_filter(policy, "me/filter", "me/car")
    assert LatentSafePolicy.from_pretrained("me/filter").config.epsilon == 0.5


def test_weights_tampered_with_on_the_hub_are_refused(hub, policy):
    push_filter(policy, "me/filter", "me/car")
    weights = bytearray(hub.repos["me/filter"]["model.safetensors"])
    weights[-1] ^= 1
    hub.repos["me/filter"]["model.safetensors"] = bytes(weights)
    with pytest.raises(CheckpointError, match="changed after saving"):
        LatentSafePolicy.from_pretrained("me/filter")


def test_card_says_what_it_is_and_what_it_is_not(hub, policy):
    policy.config.epsilon = 0.0125
    policy.config.calibration = {
        "epsilon": 0.0125, "missed": 0.05, "false_alarms": 0.1, "lead_steps": 3.0, "failing_episodes": 40.0,
        "safe_frames": 900.0,
    }  # fmt: skip
    push_filter(policy, "me/filter", "me/car")
    card = ModelCard(hub.repos["me/filter"]["README.md"].decode())
    assert card.data.license == "apache-2.0" and "latentsafe" in card.data.tags and card.data.datasets == "me/car"
    for text in ("not a certified", "| epsilon | 0.0125 |", "40 held-out failing episodes", "20 fps", "me/filter"):
        assert text in card.text
    assert "turn_rate.vel in [-1.25, 1.25]" in card.text and "monitor" in card.text


def test_card_admits_an_epsilon_set_by_hand(policy):
    card = policy.generate_model_card("me/car", "latentsafe", None, None)
    assert "| epsilon was set | by hand |" in card.text


def test_unknown_id_is_a_clear_error(hub):
    with pytest.raises(CheckpointError, match=r"(?s)could not get me/nothing.*Check the id"):
        LatentSafePolicy.from_pretrained("me/nothing")


def test_unreachable_hub_leaves_the_local_filter_alone(no_hub, tiny_filter):
    policy, before = LatentSafePolicy.from_pretrained(tiny_filter), contents(tiny_filter)
    with pytest.raises(HubUnreachableError, match=r"cannot create me/filter on http://127.*untouched.*later"):
        push_filter(policy, "me/filter", "me/car")
    assert contents(tiny_filter) == before and policy.config.repo_id is None


def test_push_that_breaks_off_is_a_clear_error(hub, policy, monkeypatch):
    def broken(*_, **__):
        raise ConnectionResetError("peer went away")

    monkeypatch.setattr("huggingface_hub.HfApi.upload_folder", broken)
    with pytest.raises(HubUnreachableError, match=r"broke off.*push again"):
        push_filter(policy, "me/filter", "me/car")


def test_unreachable_hub_is_a_clear_error_when_pulling(no_hub):
    with pytest.raises(CheckpointError, match=r"(?s)could not get me/filter.*connection"):
        LatentSafePolicy.from_pretrained("me/filter")


def test_offline_mode_is_named(policy):
    with pytest.raises(HubUnreachableError, match="offline"):
        push_filter(policy, "me/filter", "me/car")


def test_untrained_filter_is_not_pushed(hub, cache_meta):
    with pytest.raises(UntrainedFilterError):
        push_filter(tiny.new_policy(cache_meta), "me/filter", "me/car")
    assert not hub.repos


def test_push_command_reports_an_unreachable_hub(no_hub, tiny_filter):
    from lerobot_latentsafe.cli import main

    with pytest.raises(SystemExit, match="latentsafe push: cannot create me/filter"):
        main(["push", f"--policy.path={tiny_filter}", "--repo_id=me/filter"])
