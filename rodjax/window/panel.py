"""The two-dimensional part of the window: what is said, numbers, a legend, sliders and buttons of viser's panel."""

import html
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from rodjax.window.controls import Slider
from rodjax.window.numbers import Row
from rodjax.window.tube import Scale

# Of Okabe and Ito, readable on light and dark: warnings.
BAD_COLOR = "#D55E00"


class Buttons(NamedTuple):
    """What the buttons and choices do."""

    undo: Callable[[], None]
    start_over: Callable[[], None]
    save_scene: Callable[[Any], None]  # with the client whose user asked
    color_by: Callable[[str], None]
    fit_colors: Callable[[], None]
    show_loads: Callable[[bool], None]
    show_handles: Callable[[bool], None]
    show_dark: Callable[[bool], None]
    number: Callable[[str, float], None]
    record: Callable[[bool], None]
    play: Callable[[], None]
    show_recorded: Callable[[int], None]
    show_fan: Callable[[bool], None]
    save_recording: Callable[[Any], None]
    save_film: Callable[[Any], None]


class Panel:
    """Built once; `say`, `show_rows` and the others change what it shows."""

    def __init__(
        self,
        gui: Any,
        sliders: Sequence[Slider],
        values: dict[str, float],
        colors: dict[str, str],
        do: Buttons,
        has_steps: bool = False,
        is_dark: bool = False,
    ):
        self.gui = gui
        self.message = gui.add_html("")
        self.rows = gui.add_html("")
        self.labels = {label: name for name, label in colors.items()}
        self.color = gui.add_dropdown("Colour", tuple(self.labels), initial_value=next(iter(self.labels)))
        self.legend = gui.add_html("")
        self._when(self.color, lambda value: do.color_by(self.labels[value]))
        self._button("Fit the colours", lambda client: do.fit_colors())
        loads = gui.add_checkbox("Forces and moments", True, hint="Forces: orange; moments: blue, with two heads")
        self._when(loads, do.show_loads)
        self._when(gui.add_checkbox("Handles", True), do.show_handles)
        self._when(gui.add_checkbox("Dark page", is_dark), do.show_dark)
        with gui.add_folder("Change"):
            self.sliders = {slider.name: self._slider(slider, values[slider.name], do.number) for slider in sliders}
        self._button("Undo", lambda client: do.undo())
        self._button("Start over", lambda client: do.start_over())
        self._button("Save scene", do.save_scene, "Downloads scene.toml, which `rodjax solve` and `rodjax view` read")
        with gui.add_folder("Record", expand_by_default=has_steps):
            self.recording = gui.add_checkbox("Record moves", False)
            self._when(self.recording, do.record)
            self.frame = gui.add_slider("Step", 0, 1, 1, 0, disabled=True)
            self._when(self.frame, do.show_recorded)
            self.fan = gui.add_checkbox("All steps, pale", False, disabled=True)
            self._when(self.fan, do.show_fan)
            self._button("Play", lambda client: do.play())
            self._button(
                "Save film", do.save_film, "Downloads film.mp4, or film.gif, of all steps as they are seen here"
            )
            self._button("Save path", do.save_recording, "Downloads path.vtkhdf, which ParaView and rodjax.load read")

    def _slider(self, slider: Slider, value: float, number: Callable[[str, float], None]) -> Any:
        step = (slider.high - slider.low) / 500
        drawn = self.gui.add_slider(
            f"{slider.label} [{slider.unit}]", slider.low, slider.high, step, initial_value=value
        )
        self._when(drawn, lambda value: number(slider.name, value))
        return drawn

    @staticmethod
    def _when(element: Any, do: Callable[[Any], None]) -> None:
        async def changed(event: Any) -> None:
            # Changes of our own have no client.
            if event.client_id is not None:
                do(element.value)

        element.on_update(changed)

    def _button(self, label: str, do: Callable[[Any], None], hint: str | None = None) -> None:
        async def clicked(event: Any) -> None:
            do(event.client)

        self.gui.add_button(label, hint=hint).on_click(clicked)

    def say(self, text: str, is_bad: bool = False) -> None:
        color = f"color:{BAD_COLOR};font-weight:600" if is_bad else ""
        self._set(self.message, f'<div id="rodjax-message" style="padding:0 0.8em;{color}">{html.escape(text)}</div>')

    def show_rows(self, rows: Sequence[Row]) -> None:
        lines = "".join(
            f'<tr style="{f"color:{BAD_COLOR};font-weight:600" if row.is_bad else ""}">'
            f'<td style="opacity:0.75;padding-right:0.8em;vertical-align:top">{html.escape(row.label)}</td>'
            f'<td data-row="{html.escape(row.label)}">{html.escape(row.text)}</td></tr>'
            for row in rows
        )
        self._set(self.rows, f'<table style="font-size:0.8em;margin:0 0.8em;line-height:1.35">{lines}</table>')

    def show_legend(self, scale: Scale) -> None:
        cells = "".join(
            f'<div style="flex:1;height:1em;background:rgb({",".join(map(str, color))})"></div>'
            for color in scale.colors
        )
        last = len(scale.colors)
        marks = "".join(
            f'<span style="position:absolute;left:{100 * k / last:.4g}%;transform:translateX(-{100 * k / last:.4g}%)">'
            f"{scale.edges[k]:.4g}</span>"
            for k in (0, last // 2, last)
        )
        self._set(
            self.legend,
            f'<div style="margin:0 0.8em;font-size:0.8em"><div style="display:flex">{cells}</div>'
            f'<div style="position:relative;height:1.4em">{marks}</div></div>',
        )

    def show_numbers(self, values: dict[str, float]) -> None:
        for name, slider in self.sliders.items():
            slider.value = min(max(values[name], slider.min), slider.max)

    def show_frames(self, count: int, at: int) -> None:
        """How many moments are recorded, and which of them is shown."""
        self.frame.disabled = self.fan.disabled = count < 2
        self.frame.max = max(count - 1, 1)
        self.frame.value = max(at, 0)

    @staticmethod
    def _set(element: Any, content: str) -> None:
        if element.content != content:
            element.content = content
