"""Functions behind the API's endpoints. They call the storage, the session engine and the modelling code, and know
neither HTTP nor the types of JSON bodies."""
