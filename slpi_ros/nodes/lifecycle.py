"""What rclpy's lifecycle nodes leave to be done."""

from typing import Any

from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import LifecycleNode


def refuse_impossible_transitions(node: LifecycleNode) -> None:
    """Answer a request for a transition that the present state does not allow with a refusal.

    Without this, rclpy lets the request end the process: ``ros2 lifecycle set NODE configure`` said twice would do.
    """
    for service in node.services:
        if service.srv_type is ChangeState:
            service.callback = _refusing(node, service.callback)


def _refusing(node: LifecycleNode, change_state: Any) -> Any:
    def on_request(request: Any, response: Any) -> Any:
        try:
            return change_state(request, response)
        except RuntimeError as error:
            wanted = request.transition.label or request.transition.id
            node.get_logger().warning(f"no transition '{wanted}' from the present state: {error}")
            response.success = False
            return response

    return on_request
