"""Poses for the plant: to an MQTT broker, or from an OPC UA server."""

from rfpose.pipeline.publish.broker import Broker, SentMessages, send
from rfpose.pipeline.publish.messages import SCHEMA, messages
from rfpose.pipeline.publish.server import PlantServer, serve, serving

__all__ = ["SCHEMA", "Broker", "PlantServer", "SentMessages", "messages", "send", "serve", "serving"]
