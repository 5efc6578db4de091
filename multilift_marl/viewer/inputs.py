"""What browsers may change of the page's controls: the values of fields, to values that these can have."""

from __future__ import annotations

import math
from typing import Any

_MOST_WAITING = 16  # presses of controls that wait for their turn; what comes beside them is dropped
_UNUSED = (  # messages of browsers that no control of the page sends
    "GuiButtonHoldMessage", "GuiFormSubmitMessage", "GuiFormDirtyMessage", "FileTransferStartUpload",
    "FileTransferPart", "CommandTriggerMessage",
)  # fmt: skip


def filter_inputs(server: Any) -> None:
    """Let a server of viser take no more from browsers than `is_possible` values, and only so many at a time.

    viser itself sets any attribute of a control to what a message says, and lets any number of clicks wait.
    """
    from viser import _messages

    gui = server.gui
    interface = gui._websock_interface
    handle_update = gui._handle_gui_updates

    async def handle_possible(client_id: Any, message: Any) -> None:
        control = gui._gui_input_handle_from_uuid.get(message.uuid)
        if control is None or not isinstance(message.updates, dict) or set(message.updates) != {"value"}:
            return
        if is_possible(control, message.updates["value"]) and not _is_busy(gui, control):
            await handle_update(client_id, message)

    interface.unregister_handler(_messages.GuiUpdateMessage)
    interface.register_handler(_messages.GuiUpdateMessage, handle_possible)
    for name in _UNUSED:
        if hasattr(_messages, name):
            interface.unregister_handler(getattr(_messages, name))


def is_possible(control: Any, value: Any) -> bool:
    """Return whether a control, a button, a box, a list or a slider of viser, can have a value."""
    if isinstance(control.value, bool):
        return isinstance(value, bool)
    if hasattr(control, "options"):
        return isinstance(value, str) and value in control.options
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return number and control.min <= value <= control.max


def _is_busy(gui: Any, control: Any) -> bool:
    """Return whether too many presses wait already; what is only a value never waits."""
    return bool(control._impl.update_cb) and gui._thread_executor._work_queue.qsize() >= _MOST_WAITING
