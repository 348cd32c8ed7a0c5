"""The experiments by name, and how they are run and their reports written."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tensorsim.config.documents import find_named, from_document, to_document
from tensorsim.config.limited_yaml import dump_limited_yaml
from tensorsim.config.yaml_files import read_yaml
from tensorsim.errors import TensorsimError
from tensorsim.experiments import ablations, networks, paper, real, video
from tensorsim.experiments.work import Report, Work
from tensorsim.files import complete_or_nothing, write_text


@dataclass(frozen=True)
class Experiment:
    """A table of the paper.

    Attributes:
        title: heading of its report.
        config: its settings; the defaults have the size of the paper's experiment, as far as it is stated.
        run: (settings, work) -> report.
        quick: settings that finish within three minutes.
        parallel: whether it uses several processes.
    """

    title: str
    config: type
    run: Callable[[Any, Work], Report]
    quick: Callable[[], Any]
    parallel: bool = False


def _paper(config: paper.PaperConfig, work: Work) -> Report:
    experiments = {name: e for name, e in EXPERIMENTS.items() if name != "paper"}
    settings = {name: _settings_in_paper(name, config) for name in experiments}
    if config.data or config.films:
        settings["real"].check(work)
    else:
        del settings["real"]
    return paper.paper_report(settings, work, experiments)


def _settings_in_paper(name: str, config: paper.PaperConfig) -> Any:
    file = Path(config.settings) / f"{name}.yaml"
    folders = {"data": config.data, "films": config.films, "maps": config.maps}
    return configuration(
        name,
        config.quick,
        file if config.settings and file.is_file() else None,
        folders if name == "real" else {},
    )


EXPERIMENTS: dict[str, Experiment] = {
    "video-ablation": Experiment(
        "Detectors, trackers, pose networks and lifters on films of known motion",
        video.VideoConfig,
        video.video_report,
        video.quick_video,
    ),
    "echo-ablation": Experiment(
        "Echo without wall attenuation, without multipath",
        ablations.EchoConfig,
        ablations.echo_report,
        ablations.quick_echo,
    ),
    "denoiser-ablation": Experiment(
        "Denoisers of the maps",
        ablations.DenoiserConfig,
        ablations.denoiser_report,
        ablations.quick_denoisers,
    ),
    "networks": Experiment(
        "Recognisers in both scenes",
        networks.NetworksConfig,
        networks.networks_report,
        networks.quick_networks,
        parallel=True,
    ),
    "snr": Experiment(
        "Recognisers against noise",
        networks.NetworksConfig,
        networks.snr_report,
        networks.quick_networks,
        parallel=True,
    ),
    "inputs": Experiment(
        "Recognisers by input",
        networks.InputsConfig,
        networks.inputs_report,
        networks.quick_inputs,
        parallel=True,
    ),
    "real": Experiment(
        "Recognisers on measured radar and real films", real.RealConfig, real.real_report, real.quick_real
    ),
    "paper": Experiment(
        "All experiments",
        paper.PaperConfig,
        _paper,
        lambda: paper.PaperConfig(quick=True),
        parallel=True,
    ),
}


def find_experiment(name: str) -> Experiment:
    """The experiment of this name.

    Raises:
        TensorsimError: no such experiment; the message lists the known ones.
    """
    return find_named(EXPERIMENTS, name, "experiment")


def configuration(name: str, quick: bool, file: Path | None, options: dict[str, Any]) -> Any:
    """Settings of an experiment: default or quick ones, overridden by a YAML file, then by single options.

    Raises:
        TensorsimError: unknown names, options that this experiment does not have, invalid values.
    """
    experiment = find_experiment(name)
    if quick and file is not None:
        raise TensorsimError("--quick, --config: got both, expected one of them")
    document: dict[str, Any] = to_document(experiment.quick() if quick else experiment.config())
    if file is not None:
        read = read_yaml(file)
        if read.pop("experiment", name) != name:
            raise TensorsimError(f"{file}: got the settings of another experiment, expected those of {name}")
        document |= read
    known = [f"--{key.replace('_', '-')}" for key in document]
    for option, value in options.items():
        if option not in document:
            flag = f"--{option.replace('_', '-')}"
            raise TensorsimError(f"{flag}: {name} has no such setting, expected {', '.join(known)}")
        document[option] = list(value) if isinstance(value, tuple) else value
    config = from_document(name, experiment.config, document)
    for option, needed in config.unused().items() if isinstance(config, real.RealConfig) else ():
        if options.get(option, "") != "":
            raise TensorsimError(f"--{option.replace('_', '-')}: has no effect without {needed}")
    return config


def run_experiment(name: str, out: Path, config: Any, work: Work) -> Report:
    """Run an experiment and write its report: ``NAME.md``, ``NAME*.csv``, ``NAME-*.png`` and ``.svg``, ``NAME.yaml``.

    Files appear once all are complete; tables and figures of an earlier run that this run does not produce are
    removed. Computed results stay in the cache of ``work``.
    """
    from tensorsim.plot.figure import save_figure

    experiment = find_experiment(name)
    if work.jobs > 1 and not experiment.parallel:
        names = ", ".join(name for name, entry in EXPERIMENTS.items() if entry.parallel)
        raise TensorsimError(f"--jobs: got {work.jobs}, expected 1: only {names} take several processes")
    report = experiment.run(config, work)
    with complete_or_nothing(out) as new:
        write_text(new / f"{name}.md", report.markdown(experiment.title))
        settings = {"experiment": name} | to_document(config)
        write_text(new / f"{name}.yaml", dump_limited_yaml(settings))
        for table in report.tables:
            stem = f"{name}-{table.file}" if table.file else name
            write_text(new / f"{stem}.csv", table.csv())
        for figure_name, figure in report.figures.items():
            for suffix in ("png", "svg"):
                save_figure(figure, new / f"{name}-{figure_name}.{suffix}")
        written = {file.name for file in new.iterdir()}
    for pattern in (f"{name}.csv", f"{name}-*.csv", f"{name}-*.png", f"{name}-*.svg"):
        for file in out.glob(pattern):
            if file.name not in written:
                file.unlink()
    return report
