import json

import huggingface_hub.utils
import pytest
import tiny
import torch
from huggingface_hub import ModelCard, constants

from lerobot_latentsafe.decision import LawOptions
from lerobot_latentsafe.experiments.kills.hub_stub import Hub
from lerobot_latentsafe.modeling_latentsafe import LatentSafePolicy
from lerobot_latentsafe.runtime.hub import HubUnreachableError, push_policy, save_policy
from lerobot_latentsafe.runtime.locations import CheckpointError


def point_to(monkeypatch, hub, cache):
    for name, value in hub.settings(cache).items():
        monkeypatch.setattr(constants, name, value)
    monkeypatch.setenv("HF_TOKEN", "hf_nobody")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    huggingface_hub.utils.close_session()


@pytest.fixture
def hub(monkeypatch, tmp_path):
    with Hub() as hub:
        point_to(monkeypatch, hub, tmp_path / "cache")
        yield hub


@pytest.fixture
def no_hub(monkeypatch, tmp_path):
    """A port on which nobody answers."""
    with Hub() as closed:
        pass
    point_to(monkeypatch, closed, tmp_path / "cache")


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
    policy.config.law.epsilon = 0.03
    url = push_policy(policy, "me/filter", "me/car")
    assert url == f"{hub.url}/me/filter"
    pulled = LatentSafePolicy.from_pretrained("me/filter")
    assert pulled.config.law.epsilon == 0.03
    assert_same_decisions(policy, pulled)


def test_pushed_folder_holds_what_lerobots_commands_need(hub, policy):
    push_policy(policy, "me/filter", "me/car")
    expected = {
        "README.md", "config.json", "integrity.json", "model.safetensors", "policy_preprocessor.json",
        "policy_postprocessor.json",
    }  # fmt: skip
    assert set(hub.repos["me/filter"]) - {".gitattributes"} == expected


def test_shielded_policy_travels_with_its_base(hub, policy, tiny_diffusion):
    policy.attach(tiny_diffusion)
    push_policy(policy, "me/shielded", "me/car")
    assert "base_policy/model.safetensors" in hub.repos["me/shielded"]
    pulled = LatentSafePolicy.from_pretrained("me/shielded")
    assert pulled.base.config.type == "diffusion" and "cache" in pulled.config.base_policy_path
    assert_same_decisions(policy, pulled)


def test_base_policy_may_come_from_the_hub(hub, policy, tiny_diffusion):
    hub.repos["me/diffusion"] = {str(name): content for name, content in contents(tiny_diffusion).items()}
    hub.commits["me/diffusion"] = ["a" * 40]
    policy.attach("me/diffusion")
    assert policy.base.config.type == "diffusion"


def test_pushing_again_replaces(hub, policy):
    push_policy(policy, "me/filter", "me/car")
    policy.config.law.epsilon = 0.5
    push_policy(policy, "me/filter", "me/car")
    assert LatentSafePolicy.from_pretrained("me/filter").config.law.epsilon == 0.5


def test_weights_tampered_with_on_the_hub_are_refused(hub, policy):
    push_policy(policy, "me/filter", "me/car")
    weights = bytearray(hub.repos["me/filter"]["model.safetensors"])
    weights[-1] ^= 1
    hub.repos["me/filter"]["model.safetensors"] = bytes(weights)
    with pytest.raises(CheckpointError, match="changed after saving"):
        LatentSafePolicy.from_pretrained("me/filter")


def test_card_says_what_it_is_and_what_it_is_not(hub, policy):
    policy.config.law.epsilon = 0.0125
    push_policy(policy, "me/filter", "me/car")
    card = ModelCard(hub.repos["me/filter"]["README.md"].decode())
    assert card.data.license == "apache-2.0" and "latentsafe" in card.data.tags and card.data.datasets == "me/car"
    for text in ("not a certified", "| epsilon | 0.0125 |", "20 fps", "me/filter"):
        assert text in card.text
    assert "turn_rate.vel in [-1.25, 1.25]" in card.text and "monitor" in card.text


def test_card_admits_an_epsilon_set_by_hand(policy):
    card = policy.generate_model_card("me/car", "latentsafe", None, None)
    assert "| epsilon was set | by hand: nothing is promised |" in card.text


def test_card_says_above_what_the_base_policy_is_released(policy):
    policy.config.law.epsilon, policy.config.law.resume_above = 0.4, 0.5
    card = policy.generate_model_card("me/car", "latentsafe", None, None)
    assert "| epsilon | 0.4; once the filter acts, 0.5 |" in card.text


def test_card_says_how_much_the_filter_remembers(policy):
    policy.config.law.history_frames = 24
    card = policy.generate_model_card("me/car", "latentsafe", None, None)
    assert "px; remembers 24 frames at most |" in card.text


def test_card_says_what_acts_in_place_of_an_unsafe_action(policy):
    def said():
        card = policy.generate_model_card("me/car", "latentsafe", None, None)
        return card.text.split("| fallback | ")[1].split(" |")[0]

    assert said() == "the critic's action"
    policy.config.law.retreat, policy.config.law.min_retreat_steps = {"turn_rate.vel": -0.5}, 15
    assert said() == "the retreat (turn_rate.vel -0.5 a step) for at least 15 steps"
    policy.config.law.max_retreat_steps = 40
    assert said().endswith("for at least 15 and at most 40 steps")
    policy.config.law.retreat_after = 2
    assert said().startswith("the critic's action; after 2 overrides within 10 steps the retreat (turn_rate.vel")


def test_card_of_a_guard_says_that_there_is_no_value(policy):
    config = policy.config
    config.calibration = {"missed": 0.05, "false_alarms": 0.1, "lead_steps": 3.0, "failing_episodes": 40.0,
                          "safe_frames": 900.0}  # fmt: skip
    config.change(law=config.law.changed(LawOptions(name="guard")))
    text = policy.generate_model_card("me/car", "latentsafe", None, None).text
    assert "**there is no safety value V**" in text and "| law | guard: checks alone, there is no V |" in text
    assert "turn_rate.vel in [-1.25, 1.25]" in text and "monitor" in text and "not a certified" in text
    for told in ("epsilon", "V means", "V read", "critic", "Imagination", "world model |", "learned", "held-out"):
        assert told not in text


def test_unknown_id_is_a_clear_error(hub):
    with pytest.raises(CheckpointError, match=r"(?s)could not get me/nothing.*Check the id"):
        LatentSafePolicy.from_pretrained("me/nothing")


def test_unreachable_hub_leaves_the_local_filter_alone(no_hub, tiny_filter):
    policy, before = LatentSafePolicy.from_pretrained(tiny_filter), contents(tiny_filter)
    with pytest.raises(HubUnreachableError, match=r"cannot create me/filter on http://127.*untouched.*later"):
        push_policy(policy, "me/filter", "me/car")
    assert contents(tiny_filter) == before and policy.config.repo_id is None


def test_push_that_breaks_off_is_a_clear_error(hub, policy, monkeypatch):
    def broken(*_, **__):
        raise ConnectionResetError("peer went away")

    monkeypatch.setattr("huggingface_hub.HfApi.upload_folder", broken)
    with pytest.raises(HubUnreachableError, match=r"broke off.*push again"):
        push_policy(policy, "me/filter", "me/car")


@pytest.mark.parametrize("fault", ["500", "403", "cut"])
@pytest.mark.fault("H02", "the Hub answers 500 when weights are uploaded", "A message; the same command goes on")
@pytest.mark.fault("H04", "the connection is cut when weights are uploaded", "A message; the same command goes on")
def test_weights_that_do_not_arrive_are_pushed_by_the_same_command(hub, tiny_filter, monkeypatch, fault):
    from lerobot_latentsafe.cli import main

    monkeypatch.setattr("huggingface_hub.utils._http.time.sleep", lambda seconds: None)  # before it tries again
    before, push = contents(tiny_filter), ["push", f"--policy.path={tiny_filter}", "--repo_id=me/filter"]
    hub.fault = fault
    with pytest.raises(SystemExit, match=r"latentsafe push: upload to me/filter broke off.*push again"):
        main(push)
    assert contents(tiny_filter) == before and "config.json" not in hub.repos["me/filter"]
    hub.fault = None
    main(push)
    assert LatentSafePolicy.from_pretrained("me/filter").config.trained_on.stage == "critic"


def test_unreachable_hub_is_a_clear_error_when_pulling(no_hub):
    with pytest.raises(CheckpointError, match=r"(?s)could not get me/filter.*connection"):
        LatentSafePolicy.from_pretrained("me/filter")


def test_offline_mode_is_named(policy):
    with pytest.raises(HubUnreachableError, match="offline"):
        push_policy(policy, "me/filter", "me/car")


def test_untrained_filter_is_not_pushed(hub, cache_meta, tmp_path):
    from lerobot_latentsafe.cli import main

    save_policy(tiny.new_policy(cache_meta), tmp_path / "untrained")
    with pytest.raises(SystemExit, match="its world model was never trained"):
        main(["push", f"--policy.path={tmp_path / 'untrained'}", "--repo_id=me/filter"])
    assert not hub.repos


def test_push_command_reports_an_unreachable_hub(no_hub, tiny_filter):
    from lerobot_latentsafe.cli import main

    with pytest.raises(SystemExit, match="latentsafe push: cannot create me/filter"):
        main(["push", f"--policy.path={tiny_filter}", "--repo_id=me/filter"])


# -- a filter that sees by a frozen encoder ---


@pytest.fixture
def seeing(token_root):
    """The filter of a gru world model, whose encoder is not part of its checkpoint."""
    policy = tiny.new_policy(tiny.metadata(token_root), world_model=tiny.gru_config(), fallback_action_candidates=None)
    policy.config.trained_on.stage, policy.config.frame_cache = "critic", None
    return policy.eval()


def test_filter_on_tokens_comes_back_with_its_basis_and_the_same_encoder(hub, seeing):
    push_policy(seeing, "me/bag", "me/car")
    assert not [name for name in hub.repos["me/bag"] if "encoder" in name]
    pulled = LatentSafePolicy.from_pretrained("me/bag")
    ours, theirs = (p.config.world_model.perception for p in (seeing, pulled))
    assert theirs.encoder_hash == ours.encoder_hash and theirs.basis_hash == ours.basis_hash
    assert pulled.model.world_model.perception.basis.fitted
    assert_same_decisions(seeing, pulled)


def test_an_encoder_with_other_weights_is_refused(hub, seeing):
    seeing.config.world_model.perception.encoder_hash = "0" * 16
    push_policy(seeing, "me/bag", "me/car")
    with pytest.raises(ValueError, match="0000000000000000"):
        LatentSafePolicy.from_pretrained("me/bag")


def test_card_names_the_encoder_and_what_was_measured(hub, seeing, tmp_path):
    from lerobot_latentsafe.cli import main
    from lerobot_latentsafe.evaluation.statistics import wilson, write_json

    save_policy(seeing, tmp_path / "filter")
    rates = {"spilled": wilson(3, 100), "success": wilson(90, 100), "overridden_share": 0.123, "lost": [1, 2]}
    cells = {"bare": {"spilled": wilson(70, 100)}, "plan": {"pooled": {"spilled": wilson(44, 100)}}}
    cells["reachability"] = {"outputs/filter": {"spilled": wilson(55, 100)}, "pooled": rates}
    write_json(tmp_path / "policies.json", {"weak": cells, "command": "bag_policies.py", "commit": "abc", "date": "-"})
    options = [f"--policy.path={tmp_path / 'filter'}", f"--results=[{tmp_path / 'policies.json'}]"]
    main(["push", *options, "--repo_id=me/bag", "--dataset_repo_id=me/car"])
    text = hub.repos["me/bag"]["README.md"].decode()
    for row in (
        "| policies: weak, bare, spilled | 70/100 = 70.0% [60.4, 78.1] |",
        "| policies: weak, reachability, pooled, steps overridden | 12.3% |",
        "| policies: made by | bag_policies.py at commit abc, - |",
        f"`efficientnet_lite0` (weights {seeing.config.world_model.perception.encoder_hash})",
    ):
        assert row in text
    assert "44/100" not in text and "55/100" not in text  # another law; one filter of several
    assert LatentSafePolicy.from_pretrained("me/bag").config.evaluation["policies: weak, bare, spilled"]


def rate(**changes):
    return json.dumps({"weak": {"spilled": {"k": 3, "n": 10, "low": 0.1, "high": 0.6, **changes}}})


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "not a readable"), ('{"commit": "abc"}', "holds none of spilled"), ("[1]", "expected an object"),
        ("[" * 100_000, "not a readable"), (rate(k=11), "is no rate"), (rate(k=-1), "is no rate"),
        (rate(k=1.5), "is no rate"), (rate(k="3"), "is no rate"), (rate(n=True, k=0), "is no rate"),
        (rate(n=float("nan")), "is no rate"), (rate(low=float("nan")), "is no rate"), (rate(low=0.9), "is no rate"),
        (rate(high="1"), "is no rate"), (rate(n=None), "is no rate"),
        (json.dumps({"a": {"overridden_share": 2, **json.loads(rate())["weak"]}}), "expected a share"),
    ],
)  # fmt: skip
@pytest.mark.fault("X06", "a results file holds odd entries", "Refused, with what was expected")
@pytest.mark.fault("X07", "a results file with k > n, NaN or strings", "Refused, with what was expected")
def test_results_without_rates_are_refused(tmp_path, content, words):
    from lerobot_latentsafe.model_card import measured

    (tmp_path / "results.json").write_text(content)
    with pytest.raises(ValueError, match=words):
        measured(tmp_path / "results.json", "reachability")


@pytest.mark.fault("X07", "a results file with n = 0", "The card says: not measured")
def test_a_result_of_no_rollouts_says_so(tmp_path):
    from lerobot_latentsafe.model_card import measured

    (tmp_path / "results.json").write_text(rate(k=0, n=0))
    assert measured(tmp_path / "results.json", "reachability")["results: weak, spilled"] == "0/0, not measured"


HOSTILE = [
    "<script>window.__pwned = 1</script>", "<img src=x onerror=alert(1)>", "[click](javascript:alert(1))",
    "![x](http://evil.example/x.png)", "a\n# Pwned", "a\n---\nlicense: evil\n---\n# Pwned", "` | **x** | `",
    "a\x1b[2J\0b",
    "a\r\n\r\n```\n<script>window.__pwned = 1</script>",
]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.fault("X04", "names of data, tasks and files hold HTML or Markdown", "They are text in the card")
@pytest.mark.fault("X05", "a card is shown by a viewer that keeps HTML", "No script runs")
def test_names_are_text_in_a_card(policy, name):
    """Rendered with HTML kept, as some viewers do, where the Hub would take it out."""
    from markdown_it import MarkdownIt

    from lerobot_latentsafe.model_card import make_task_policy_card

    config = policy.config
    config.trained_on.robot_type, config.trained_on.state_names = name, [name, "y"]
    config.margin.failure_specification = config.base_policy_path = config.repo_id = name
    config.evaluation = {name: name}
    config.calibration = {"missed": float("nan"), "failing_episodes": 3.0}
    filter_card = policy.generate_model_card(name, "latentsafe", name, [name])
    for card in (filter_card, make_task_policy_card(name, name, name, name, [name])):
        page = MarkdownIt("commonmark", {"html": True}).enable("table").render(card.text)
        for tag in ("<script", "<img", 'href="javascript:', "Pwned</h1>", "<strong>x"):
            assert tag not in page, card.text
        assert card.data.tags is not None and "\n" not in card.data.license and card.data.license != "evil"
    assert "evidence is not whole" in filter_card.text


@pytest.mark.parametrize("shielded", [False, True])
def test_lerobots_own_push_is_the_same(hub, seeing, shielded, tiny_diffusion):
    """`--policy.push_to_hub=true` of lerobot-train."""
    from lerobot.configs.default import DatasetConfig
    from lerobot.configs.train import TrainPipelineConfig

    from lerobot_latentsafe.processor_latentsafe import make_latentsafe_pre_post_processors

    if shielded:
        seeing.attach(tiny_diffusion)
    seeing.config.repo_id = "me/trained"
    config = TrainPipelineConfig(dataset=DatasetConfig(repo_id="me/car"), policy=seeing.config)
    seeing.push_model_to_hub(config)
    for pipeline in make_latentsafe_pre_post_processors(seeing.config):
        pipeline.push_to_hub("me/trained")
    pulled = LatentSafePolicy.from_pretrained("me/trained")
    assert (pulled.base is not None) == shielded
    assert "not a certified" in hub.repos["me/trained"]["README.md"].decode()
    assert_same_decisions(seeing, pulled)


def test_a_task_policy_is_pushed_without_what_belongs_to_a_filter(hub, tiny_dreamer, tmp_path):
    from lerobot_latentsafe.cli import main

    options = [f"--policy.path={tiny_dreamer / 'policy'}", "--repo_id=me/task"]
    with pytest.raises(SystemExit, match="belong to a filter"):
        main(["push", *options, "--results=[results.json]"])
    main(["push", *options])
    assert "Task policy learned in imagination" in hub.repos["me/task"]["README.md"].decode()
