"""Poses for the plant: to an MQTT broker, or from an OPC UA server."""

from rfpose.pipeline.publish.broker import Broker, SentMessages, send
from rfpose.pipeline.publish.job import publish
from rfpose.pipeline.publish.messages import SCHEMA, messages, messages_as_they_come
from rfpose.pipeline.publish.server import PlantServer, serve, serve_as_they_come, serving

__all__ = [
    "SCHEMA",
    "Broker",
    "PlantServer",
    "SentMessages",
    "messages",
    "messages_as_they_come",
    "publish",
    "send",
    "serve",
    "serve_as_they_come",
    "serving",
]
